// Reads a model file (docs/model_file.md) without bodyschema and prints its outputs: node read_model.js FILE ANGLE...
// FILE is what the key `model` answers or KBMap.to_bytes gives. Angles in rad, in m for a joint that slides. Outputs:
// the marker's x, y, z [m]; where the map has an orientation, then the columns e1, e2, e3 of its rotation matrix.
"use strict";

function read(bytes) {
  if (bytes.toString("latin1", 0, 12) !== "KBMAP\r\n\0\x01\0\0\0") throw new Error("not a model file of version 1");
  const start = 16 + bytes.readUInt32LE(12);
  const header = JSON.parse(bytes.toString("utf8", 16, start));
  const count = header.bases.reduce((n, b) => n * (b.kind.startsWith("prismatic") ? 2 : 3), header.outputs);
  if (bytes.length !== start + 8 * count + 16) throw new Error("the file is damaged or truncated");
  return { ...header, net: Array.from({ length: count }, (_, i) => bytes.readDoubleLE(start + 8 * i)) };
}

function weights({ kind, parameters: p }, q) {
  if (kind === "trigonometric") return [1, Math.cos(q), Math.sin(q)];
  if (kind === "bernstein") {
    const u = Math.sin((q - p.centre - p.alpha) / 2) / Math.sin(p.alpha);
    const v = Math.sin((q - p.centre + p.alpha) / 2) / Math.sin(p.alpha);
    return [u * u, -2 * Math.cos(p.alpha) * u * v, v * v];
  }
  const share = (q - p.low) / (p.high - p.low);
  if (kind === "prismatic") return [1 - share, share];
  if (kind === "prismatic_orthonormal") return [1, Math.sqrt(12) * p.scale * (share - 0.5)];
  if (kind !== "orthonormal") throw new Error(`unknown basis ${kind}`);
  const t = q - (p.low + p.high) / 2, h = Math.min((p.high - p.low) / 2, Math.PI);
  const mean = Math.sin(h) / h, half = Math.sin(2 * h) / (4 * h);
  const cosine = (Math.cos(t) - mean) / Math.sqrt(0.5 + half - mean * mean);
  return [1, p.scale * cosine, p.scale * Math.sin(t) / Math.sqrt(0.5 - half)];
}

const [file, ...angles] = process.argv.slice(2);
const model = read(require("fs").readFileSync(file));
if (angles.length !== model.bases.length) throw new Error(`give ${model.bases.length} angles`);
const outputs = model.bases.reduceRight((values, basis, k) => {  // the last joint's index runs fastest
  const w = weights(basis, Number(angles[k]));
  const one = (i) => w.reduce((sum, wj, j) => sum + wj * values[i * w.length + j], 0);
  return Array.from({ length: values.length / w.length }, (_, i) => one(i));
}, model.net);
console.log(JSON.stringify(outputs));
