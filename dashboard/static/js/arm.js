// The arm at its newest pair: links by the URDF, the marker as measured and as predicted, and the camera.
import { text } from "./dom.js";
import { mm } from "./format.js";
import { color, dot, line, Orbit } from "./orbit.js";

// Thickness of a link, as a share of the arm's size; lines of the ground; length of the camera's axes.
const THICK = 0.034;
const GRID = 8;
const AXIS = 0.12;
// The root link has z up; the view has y down and z forward.
const upright = ([x, y, z]) => [x, -z, y];

export class Arm extends Orbit {
  constructor() {
    super("arm");
    this.document = null;
  }

  update(document) {
    this.document = document;
    if (!document) return;
    const apart = document.apart_m === null ? "no model answers" : `prediction and measurement are ${mm(document.apart_m)} apart`;
    const said = `Pair ${document.pair}: ${apart}.${document.placed ? "" : " The camera's pose is not known yet: the marker is drawn at robot.toml's guess."}`;
    text("arm-text", said);
    this.canvas.setAttribute("aria-label", said);
    this.draw();
  }

  paint(pen, width, height) {
    if (!this.document) return;
    const { links, joints, camera, measured, predicted } = this.document;
    const tubes = links.map((ends) => ends.map(upright));
    const body = [...tubes.flat(), [0, 0, 0]];
    // The camera may be far away: it is drawn where it is if it is in sight, and does not shrink the arm.
    const { project, factor } = this.projection([...body, upright(measured)], width, height);
    const size = Math.min(width, height) / factor / this.view.zoom;
    this.ground(pen, project, size);
    const order = tubes.map(([from, to]) => [project(from), project(to)]).sort((a, b) => a[0][2] + a[1][2] - b[0][2] - b[1][2]);
    pen.lineCap = "round";
    const thick = Math.max(THICK * size * factor, 3 * devicePixelRatio);
    for (const [from, to] of order) {
      for (const [name, width] of [["--soft", thick], ["--track", 0.72 * thick]]) {
        pen.strokeStyle = color(name);
        pen.lineWidth = width;
        line(pen, from, to);
      }
    }
    pen.fillStyle = color("--line");
    for (const joint of joints) dot(pen, project(upright(joint)), 0.3 * thick);
    this.camera(pen, project, camera.map((point, k) => upright(k ? point.map((value, axis) => camera[0][axis] + AXIS * size * value) : point)));
    pen.lineWidth = 2 * devicePixelRatio;
    pen.strokeStyle = color("--second");
    if (predicted) {
      line(pen, project(upright(predicted)), project(upright(measured)));
      pen.beginPath();
      pen.arc(...project(upright(predicted)).slice(0, 2), 6 * devicePixelRatio, 0, 7);
      pen.stroke();
    }
    pen.fillStyle = color("--mark");
    dot(pen, project(upright(measured)), 3.2 * devicePixelRatio);
  }

  ground(pen, project, size) {
    const step = 10 ** Math.floor(Math.log10(size / 2));
    const half = step * Math.ceil((0.4 * size) / step);
    pen.strokeStyle = color("--rule");
    pen.lineWidth = devicePixelRatio;
    for (let k = -GRID; k <= GRID; k++) {
      const at = k * step;
      if (Math.abs(at) > half + 1e-9) continue;
      line(pen, project([at, 0, -half]), project([at, 0, half]));
      line(pen, project([-half, 0, at]), project([half, 0, at]));
    }
  }

  camera(pen, project, [eye, x, y, z]) {
    pen.lineWidth = 1.5 * devicePixelRatio;
    pen.strokeStyle = pen.fillStyle = color("--good");
    const corner = (a, b) => z.map((value, k) => value + a * (x[k] - eye[k]) * 0.6 + b * (y[k] - eye[k]) * 0.45);
    const corners = [[1, 1], [1, -1], [-1, -1], [-1, 1]].map(([a, b]) => project(corner(a, b)));
    const from = project(eye);
    corners.forEach((to, k) => {
      line(pen, from, to);
      line(pen, to, corners[(k + 1) % 4]);
    });
    pen.font = `${11 * devicePixelRatio}px system-ui`;
    pen.fillText("camera", from[0] + 5 * devicePixelRatio, from[1] - 5 * devicePixelRatio);
  }
}
