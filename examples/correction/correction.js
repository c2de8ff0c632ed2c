// Reads correction.json (docs/exporting.md) without bodyschema: readings in, true joint angles and marker pose out.
// node correction.js correction.json < readings.txt    readings in each line; prints the angles, then the pose

class Correction {
  constructor(text) {
    const { format, numbers } = JSON.parse(text);
    if (format !== "bodyschema correction 3")
      throw new Error("not a correction of version 3: write it again with `bodyschema export`");
    [this.joints, this.end] = numbers;
    this.numbers = Float64Array.from(numbers);  // registers, then the program: steps of five whole numbers
  }

  // True joint angles, and the marker's pose (3 rows of 4) in the measurement frame, at the next readings.
  // pace: time since the last readings, as a multiple of the usual one; null after an interruption.
  // A reading that is not finite makes what depends on it NaN, and is not remembered.
  read(readings, pace = 1) {
    const r = this.numbers, d = this.joints;
    if (readings.length !== d) throw new Error("another number of readings than of joints");
    if (!readings.every((x) => typeof x === "number")) throw new TypeError("a reading is not a number");
    r.set(readings.map((x) => (Number.isFinite(x) ? x : NaN)), 15 + d);
    r[2] = pace === null ? -1 : pace;
    for (let k = this.end; k < r.length; k += 5) run(r, r[k], r[k + 1], r[k + 2], r[k + 3], r[k + 4]);
    return { angles: [...r.subarray(15, 15 + d)], pose: [...r.subarray(3, 15)] };
  }
}

function run(r, step, to, a, b, c) {
  if (step < 2) for (let k = 0; k < 1 + 2 * step; k++) r[to + k] = r[a + k] + r[c] * r[b + k];
  else if (step === 2) r[to] = r[a] + r[c] * Math.sin(r[c + 1] * r[b] + r[c + 2]);
  else if (step === 3 && !Number.isNaN(r[a])) remember(r, to, r[a], r[b], r[c], r[c + 1]);
  else if (step === 4) r[to] = r[c] ? r[a + 3] * r[b + 2] : r[a] * r[b + 1] - r[a + 1] * r[b];
  else if (step === 5) r[to] = Math.abs(r[a]) > (r[b] ? r[c] : -1) ? (r[a] < 0 ? -1 : 1) : r[b];
  else if (step > 5) move(r, step, to, a, r[b], c + 1, r[c]);
}

// Set a strain (kind 0 play, 1 hysteresis, 2 settling), its last reading, and how far it has begun.
function remember(r, to, reading, pace, kind, scale) {
  const move = r[to + 2] ? reading - r[to + 1] : 0, way = Math.sign(move), x = (way * move) / scale;
  const left = r[to + 2] > 1 ? 1 - way * r[to] : 0;  // the first move shows the side
  if (kind === 2) r[to] = pace < 0 ? 0 : move + Math.sign(scale) * Math.abs(scale) ** pace * r[to];
  else if (move) r[to] = way * (1 - (kind ? left * Math.exp(-x) : Math.max(left - x, 0)));
  r[to + 1] = reading;
  r[to + 2] = move ? 2 : Math.max(r[to + 2], 1);
}

// Set by a joint's motion and pose what a body weighs, inwards, or rows of a pose, outwards.
function move(r, step, to, a, by, P, slides) {
  const u = slides ? 1 : Math.cos(by), v = slides ? 0 : Math.sin(by), shift = slides ? by : 0;
  const x = u * r[a] - v * r[a + 1], y = v * r[a] + u * r[a + 1], z = r[a + 2] + shift * r[a + 3];
  for (let k = 0; step === 6 && k < 3; k++, P += 4)
    r[to + k] = r[P] * x + r[P + 1] * y + r[P + 2] * z + r[P + 3] * r[a + 3];
  for (let row = 6; row < step; row++, a += 4, to += 4) {
    const [x, y, z, w] = [0, 1, 2, 3].map((k) => r[P + k] * r[a] + r[P + 4 + k] * r[a + 1] + r[P + 8 + k] * r[a + 2]);
    r.set([u * x + v * y, u * y - v * x, z, w + r[a + 3] + shift * z], to);
  }
}

module.exports = { Correction };
if (require.main === module) {
  const fs = require("fs"), correction = new Correction(fs.readFileSync(process.argv[2], "utf8"));
  const number = (word) => {
    if (!/^[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|nan|inf|infinity)$/i.test(word)) throw Error("not a number: " + word);
    return Number(word);
  };
  for (const line of fs.readFileSync(0, "utf8").split("\n")) {
    const words = line.match(/[^ \t\r\v\f,]+/g);
    if (words) console.log(Object.values(correction.read(words.map(number))).flat().join(" "));
  }
}
