// Reads correction.json (docs/exporting.md) without bodyschema: readings in, true joint angles and marker pose out.
// node correction.js correction.json < readings.txt    readings in each line; prints the angles, then the pose

class Correction {
  constructor(text) {
    Object.assign(this, JSON.parse(text));
    if (this.format !== "bodyschema correction" || this.version !== 2)
      throw new Error("not a correction of version 2: write it again with `bodyschema export`");
  }

  // True joint angles, and the marker's pose (3 rows of 4) in the measurement frame, at the next readings.
  // pace: time since the last readings, as a multiple of the usual one; null after an interruption.
  // A reading that is not finite makes what depends on it NaN, and is not remembered.
  read(readings, pace = 1) {
    const angles = this.zeros.slice(), q = readings.map((x) => (Number.isFinite(x) ? x : NaN));
    if (q.length !== angles.length) throw new Error("another number of readings than of joints");
    for (const [joint, source, factor] of this.ratios) angles[joint] += factor * q[source];
    for (const [joint, size, rate, phase] of this.waves) angles[joint] += size * Math.sin(rate * q[joint] + phase);
    for (const [joint, kind, amount, scale, state] of this.memories)
      if (!Number.isNaN(q[joint])) angles[joint] -= amount * strain(kind, scale, state, q[joint], pace);
    const free = angles.slice(), loads = this.loads.slice();  // a load is mass times place, and mass
    for (const [joint, body, ...rest] of this.carried) carry(loads, body, ...rest, angles[joint]);
    for (const [loose, inside] of this.passes) this.giveWay(loose, inside, free, loads.slice(), angles);
    const columns = this.chain.reduceRight((c, [slides, pose], k) => through(pose, slides, angles[k], c), this.marker);
    return { angles, pose: [0, 1, 2].flatMap((row) => columns.map((column) => column[row])) };
  }

  giveWay(loose, inside, free, loads, angles) {  // let the springs yield to gravity, or all that is loose
    const downs = [this.gravity];
    for (const [joint, parent, slides, [a, b, c, , d, e, f, , g, h, i]] of this.bodies) {
      const [p, q, r] = downs[parent], turn = slides ? 0 : angles[joint], u = Math.cos(turn), v = Math.sin(turn);
      const x = a * p + d * q + g * r, y = b * p + e * q + h * r, z = c * p + f * q + i * r;
      downs.push([u * x + v * y, u * y - v * x, z]);
    }
    for (let body = this.bodies.length; body > inside; body--) {
      const [joint, parent, slides, pose, spring] = this.bodies[body - 1], [compliance, half, hold, side] = spring;
      const [a, b, , mass] = loads[body], [x, y, z] = downs[body], torque = slides ? mass * z : a * y - b * x;
      carry(loads, body, parent, slides, pose, angles[joint]);
      if (loose && Math.abs(torque) > (side ? hold : -1)) spring[3] = torque < 0 ? -1 : 1;  // where it rests
      angles[joint] = loose ? angles[joint] + half * spring[3] : free[joint] + compliance * torque;
    }
  }
}

function carry(loads, body, parent, slides, pose, angle) {  // add the load of a body to that of its parent
  const [load] = through(pose, slides, angle, [loads[body]]);
  loads[parent] = loads[parent].map((own, n) => own + load[n]);
}

function strain(kind, scale, state, reading, pace) {  // of a memory: 0 play, 1 hysteresis, 2 settling
  const [begun, last, before] = state, move = begun ? reading - last : 0, way = Math.sign(move);
  const x = (way * move) / scale, left = begun > 1 ? 1 - way * before : 0;  // the first move shows the side
  if (kind === 2) state[2] = pace === null ? 0 : move + Math.sign(scale) * Math.abs(scale) ** pace * before;
  else if (move) state[2] = way * (1 - (kind ? left * Math.exp(-x) : Math.max(left - x, 0)));
  [state[0], state[1]] = [move ? 2 : Math.max(begun, 1), reading];
  return state[2];
}

// Vectors (x, y, z, w) after a joint's motion, in the frame in which its own has this pose.
function through([a, b, c, p, d, e, f, q, g, h, i, r], slides, angle, vectors) {
  const u = slides ? 1 : Math.cos(angle), v = slides ? 0 : Math.sin(angle), shift = slides ? angle : 0;
  return vectors.map(([s, t, l, w]) => {
    const x = u * s - v * t, y = v * s + u * t, z = l + shift * w;
    return [a * x + b * y + c * z + p * w, d * x + e * y + f * z + q * w, g * x + h * y + i * z + r * w, w];
  });
}

module.exports = { Correction };
if (require.main === module) {
  const fs = require("fs"), correction = new Correction(fs.readFileSync(process.argv[2], "utf8"));
  for (const line of fs.readFileSync(0, "utf8").split("\n").filter((each) => each.trim()))
    console.log(Object.values(correction.read(line.match(/[^\s,]+/g).map(Number))).flat().join(" "));
}
