// Residuals in space.
import { byId, text } from "./dom.js";
import { mm } from "./format.js";
import { box, color, dot, line, Orbit } from "./orbit.js";

export class Cloud extends Orbit {
  constructor() {
    super("cloud");
    this.document = null;
  }

  update(document) {
    this.document = document;
    const shown = document && document.x.length > 0;
    this.stretch = shown ? stretchOf(document) : 100;
    text("cloud-stretch", String(this.stretch));
    const said = shown
      ? `${document.x.length} pairs with this tool, all learnt already: median ${mm(document.median_m)}, 95 % within ${mm(document.p95_m)}.`
      : "No residuals yet";
    text("cloud-text", said);
    this.canvas.setAttribute("aria-label", said);
    this.draw();
  }

  paint(pen, width, height) {
    if (!this.document?.x.length) return;
    const { x, residual, segment } = this.document;
    const { project } = this.projection(x, width, height);
    this.frame(pen, project, ...box(x));
    const newest = segment.at(-1);
    const order = x.map((point, k) => [project(point), k]).sort((a, b) => a[0][2] - b[0][2]);
    pen.lineWidth = 1.2 * devicePixelRatio;
    for (const [place, k] of order) {
      const fresh = segment[k] === newest;
      pen.strokeStyle = color("--second");
      pen.globalAlpha = fresh ? 0.95 : 0.55;
      line(pen, place, project(x[k].map((value, axis) => value - this.stretch * residual[k][axis])));
      pen.fillStyle = color(fresh ? "--mark" : "--line");
      dot(pen, place, (fresh ? 2.4 : 1.7) * devicePixelRatio);
    }
    pen.globalAlpha = 1;
  }

  frame(pen, project, low, high) {
    const corner = (k) => [0, 1, 2].map((axis) => ((k >> axis) & 1 ? high[axis] : low[axis]));
    pen.strokeStyle = color("--rule");
    pen.lineWidth = devicePixelRatio;
    for (let k = 0; k < 8; k++) {
      for (const axis of [1, 2, 4]) {
        if (k & axis) continue;
        const [from, to] = [project(corner(k)), project(corner(k | axis))];
        line(pen, from, to);
      }
    }
    pen.fillStyle = color("--soft");
    pen.font = `${11 * devicePixelRatio}px system-ui`;
    ["x", "y", "z"].forEach((name, axis) => {
      const [u, v] = project(corner(1 << axis));
      pen.fillText(`${name} ${(high[axis] - low[axis]).toFixed(2)} m`, u + 4 * devicePixelRatio, v - 4 * devicePixelRatio);
    });
  }
}

// 1, 2 or 5 times a power of ten, so that most lines are a twelfth of the box.
function stretchOf({ x, p95_m: residual }) {
  const [low, high] = box(x);
  const wanted = Math.hypot(...high.map((value, k) => value - low[k])) / 12 / Math.max(residual, 1e-9);
  const power = 10 ** Math.floor(Math.log10(Math.max(wanted, 1)));
  return power * ([5, 2].find((digit) => wanted >= digit * power) ?? 1);
}
