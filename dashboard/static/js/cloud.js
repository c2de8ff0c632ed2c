// Residuals in space: an orthographic view that is turned by hand.
import { byId, text } from "./dom.js";
import { mm } from "./format.js";

const STEP = 0.12;
const START = { turn: 0.6, tilt: 0.45, zoom: 1 };
const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

export class Cloud {
  constructor() {
    this.canvas = byId("cloud");
    this.view = { ...START };
    this.document = null;
    this.pointers = new Map();
    this.listen();
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

  listen() {
    const { canvas } = this;
    new ResizeObserver(() => this.draw()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    canvas.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && document.activeElement !== canvas) return; // the page scrolls
      event.preventDefault();
      this.zoom(Math.exp(-0.002 * event.deltaY));
    }, { passive: false });
    byId("cloud-reset").addEventListener("click", () => this.move(() => Object.assign(this.view, START)));
  }

  key(event) {
    const moves = {
      ArrowLeft: () => (this.view.turn -= STEP),
      ArrowRight: () => (this.view.turn += STEP),
      ArrowUp: () => (this.view.tilt += STEP),
      ArrowDown: () => (this.view.tilt -= STEP),
      "+": () => this.zoom(1.2),
      "=": () => this.zoom(1.2),
      "-": () => this.zoom(1 / 1.2),
      0: () => Object.assign(this.view, START),
    };
    if (!moves[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    this.move(moves[event.key]);
  }

  drag(event) {
    const last = this.pointers.get(event.pointerId);
    if (!last || this.pointers.size !== 1) return;
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    this.move(() => {
      this.view.turn += 0.008 * (event.clientX - last[0]);
      if (event.pointerType === "mouse") this.view.tilt += 0.008 * (event.clientY - last[1]);
    });
  }

  zoom(factor) {
    this.move(() => (this.view.zoom = Math.min(Math.max(this.view.zoom * factor, 0.3), 12)));
  }

  move(change) {
    change();
    this.view.tilt = Math.min(Math.max(this.view.tilt, -1.57), 1.57);
    if (!this.waiting) this.waiting = requestAnimationFrame(() => this.draw());
  }

  draw() {
    this.waiting = null;
    const { canvas } = this;
    const scale = devicePixelRatio;
    const width = (canvas.width = canvas.clientWidth * scale);
    const height = (canvas.height = canvas.clientHeight * scale);
    const pen = canvas.getContext("2d");
    pen.clearRect(0, 0, width, height);
    if (!this.document?.x.length) return;
    const { x, residual, segment } = this.document;
    const [low, high] = box(x);
    const size = Math.hypot(...high.map((value, k) => value - low[k])) || 1;
    const factor = (0.98 * this.view.zoom * Math.min(width, height)) / size;
    const middle = low.map((value, k) => (value + high[k]) / 2);
    const project = this.projection(middle, factor, width, height);
    this.frame(pen, project, low, high);
    const newest = segment.at(-1);
    const order = x.map((point, k) => [project(point), k]).sort((a, b) => a[0][2] - b[0][2]);
    for (const [[u, v], k] of order) {
      const tip = project(x[k].map((value, axis) => value - this.stretch * residual[k][axis]));
      const fresh = segment[k] === newest;
      pen.strokeStyle = color("--second");
      pen.globalAlpha = fresh ? 0.95 : 0.55;
      pen.lineWidth = 1.2 * scale;
      pen.beginPath();
      pen.moveTo(u, v);
      pen.lineTo(tip[0], tip[1]);
      pen.stroke();
      pen.fillStyle = color(fresh ? "--mark" : "--line");
      pen.beginPath();
      pen.arc(u, v, (fresh ? 2.4 : 1.7) * scale, 0, 7);
      pen.fill();
    }
    pen.globalAlpha = 1;
  }

  // The measurement frame has y down and z forward: up on the page is -y.
  projection(middle, factor, width, height) {
    const [c, s] = [Math.cos(this.view.turn), Math.sin(this.view.turn)];
    const [ct, st] = [Math.cos(this.view.tilt), Math.sin(this.view.tilt)];
    return (point) => {
      const [a, b, d] = point.map((value, k) => value - middle[k]);
      const across = c * a + s * d;
      const away = -s * a + c * d;
      return [width / 2 + factor * across, height / 2 + factor * (ct * b - st * away), -(st * b + ct * away)];
    };
  }

  frame(pen, project, low, high) {
    const corner = (k) => [0, 1, 2].map((axis) => ((k >> axis) & 1 ? high[axis] : low[axis]));
    pen.strokeStyle = color("--rule");
    pen.lineWidth = devicePixelRatio;
    for (let k = 0; k < 8; k++) {
      for (const axis of [1, 2, 4]) {
        if (k & axis) continue;
        const [from, to] = [project(corner(k)), project(corner(k | axis))];
        pen.beginPath();
        pen.moveTo(from[0], from[1]);
        pen.lineTo(to[0], to[1]);
        pen.stroke();
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

function box(points) {
  const low = [0, 1, 2].map((axis) => Math.min(...points.map((point) => point[axis])));
  const high = [0, 1, 2].map((axis) => Math.max(...points.map((point) => point[axis])));
  return [low, high];
}

// 1, 2 or 5 times a power of ten, so that most lines are a twelfth of the box.
function stretchOf({ x, p95_m: residual }) {
  const [low, high] = box(x);
  const wanted = Math.hypot(...high.map((value, k) => value - low[k])) / 12 / Math.max(residual, 1e-9);
  const power = 10 ** Math.floor(Math.log10(Math.max(wanted, 1)));
  return power * ([5, 2].find((digit) => wanted >= digit * power) ?? 1);
}
