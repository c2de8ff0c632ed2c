// Reads correction.json (docs/exporting.md) without bodyschema: readings in, true joint angles and marker pose out.
// node correction.js correction.json < readings.txt    readings in each line; prints the angles, then the pose
"use strict";

class Correction {
  constructor(text) {
    Object.assign(this, JSON.parse(text));
    if (this.format !== "bodyschema correction" || this.version !== 1) throw new Error("not a correction of version 1");
    this.root = this.joints.length;  // the frame of the root link, which has the number -1 in the file
    this.springs = this.joints.some((joint) => joint.compliance);
    this.loose = this.effects.filter(({ effect }) => effect === "gravity_backlash");
  }

  // True joint angles, and the marker's pose (3 rows of 4) in the measurement frame, at the next readings.
  // pace: time since the last readings, as a multiple of the usual one; null after an interruption.
  read(q, pace = 1) {
    const unloaded = q.slice();
    for (const effect of this.effects) unloaded[effect.joint] += this.error(effect, q, pace);
    let angles = unloaded, frames = this.frames(angles);
    for (let round = 0; this.springs && round < 3; round++) {  // what gives moves its own load
      const torques = this.torques(frames);
      angles = unloaded.map((angle, k) => angle + this.joints[k].compliance * torques[k]);
      frames = this.frames(angles);
    }
    if (this.loose.length) {
      const torques = this.torques(frames);
      for (const { joint, values: [width, hold], state } of this.loose) {  // the state: the side on which it rests
        if (!state.length || Math.abs(torques[joint]) > hold) state[0] = torques[joint] < 0 ? -1 : 1;
        angles[joint] += (width / 2) * state[0];
      }
      frames = this.frames(angles);
    }
    const [camera, marker] = [this.camera, this.marker].map((end) => product(this.above(frames, end), end.pose));
    const [a, b, c, x, d, e, f, y, g, h, i, z] = camera;
    const back = [a, d, g, -a * x - d * y - g * z, b, e, h, -b * x - e * y - h * z, c, f, i, -c * x - f * y - i * z];
    return { angles, pose: product(back, marker) };
  }

  error({ effect, joint, source, values: [a, b, c], state }, q, pace) {  // what an effect adds to its joint's reading
    const reading = q[joint];
    switch (effect) {
      case "joint_offset": return a;
      case "joint_scale": return a * reading;
      case "joint_coupling": return a * q[source];
      case "joint_eccentricity":
        return Math.asin(Math.max(-0.95, Math.min(0.95, a * Math.sin(reading) + b * Math.cos(reading))));
      case "joint_ripple": return a * Math.sin(c * reading) + b * Math.cos(c * reading);
      case "backlash": {  // the state: where the joint is, and whether it has ever moved
        let [output, moved] = state.length ? state : [reading, false];
        // It begins on the side to which its first move leads.
        if (!moved && reading !== output) [output, moved] = [output - (Math.sign(reading - output) * a) / 2, true];
        if (moved) output = Math.max(reading - a / 2, Math.min(reading + a / 2, output));
        [state[0], state[1]] = [output, moved];
        return output - reading;
      }
      case "settling": {  // the state: the last reading, and what was missing of it
        const [last, missing] = state.length ? state : [reading, 0];
        [state[0], state[1]] = [reading, pace === null ? 0 : a * (reading - last) + missing * b ** pace];
        return -state[1];
      }
      case "hysteresis": {  // the state: the last reading, and the strain from -1 to 1; 0 until it has moved
        const [last, strain] = state.length ? state : [reading, 0];
        const way = Math.sign(reading - last), kept = Math.exp(-Math.abs(reading - last) / b);
        [state[0], state[1]] = [reading, !way ? strain : !strain ? way : way * (1 - kept) + kept * strain];
        return -a * state[1];
      }
      case "gravity_backlash": return 0;  // it follows the load, after the springs
      default: throw new Error(`unknown effect ${effect}`);
    }
  }

  above(frames, { parent }) { return frames[parent < 0 ? this.root : parent]; }

  frames(angles) {  // of all joints in the root link's frame
    const frames = Array(this.root).concat([[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]]);
    for (const k of this.outwards) {
      const frame = product(this.above(frames, this.joints[k]), this.joints[k].pose);
      const u = Math.cos(angles[k]), v = Math.sin(angles[k]);
      for (let i = 0; i < 12; i += 4) {
        const [a, b] = [frame[i], frame[i + 1]];
        if (this.joints[k].slides) frame[i + 3] += angles[k] * frame[i + 2];
        else [frame[i], frame[i + 1]] = [u * a + v * b, u * b - v * a];
      }
      frames[k] = frame;
    }
    return frames;
  }

  torques(frames) {  // of gravity about each joint, or its force along it
    const sums = frames.map(() => [0, 0, 0]), torques = [];  // mass, and mass times x and y
    for (const k of [...this.outwards].reverse()) {
      const { mass_kg: m, moment_kg_m: [u, v, w], parent, slides } = this.joints[k];
      const [a, b, c, x, d, e, f, y, , , i] = frames[k];
      const own = [m, m * x + a * u + b * v + c * w, m * y + d * u + e * v + f * w];
      const [mass, mx, my] = sums[k] = sums[k].map((sum, n) => sum + own[n]);
      torques[k] = this.gravity_m_s2 * (slides ? -mass * i : f * (mx - mass * x) - c * (my - mass * y));
      const above = sums[parent < 0 ? this.root : parent];
      sums[k].forEach((sum, n) => { above[n] += sum; });
    }
    return torques;
  }
}

function product(P, Q) {  // one pose after another
  const R = Array(12);
  for (let r = 0; r < 12; r += 4)
    for (let c = 0; c < 4; c++)
      R[r + c] = P[r] * Q[c] + P[r + 1] * Q[4 + c] + P[r + 2] * Q[8 + c] + (c === 3 ? P[r + 3] : 0);
  return R;
}

module.exports = { Correction };
if (require.main === module) {
  const fs = require("fs"), correction = new Correction(fs.readFileSync(process.argv[2], "utf8"));
  for (const line of fs.readFileSync(0, "utf8").trim().split("\n")) {
    const { angles, pose } = correction.read(line.trim().split(/\s+/).map(Number));
    console.log([...angles, ...pose].join(" "));
  }
}
