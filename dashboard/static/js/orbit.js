// A canvas with an orthographic view that is turned by hand.
import { byId } from "./dom.js";

const STEP = 0.12;
const START = { turn: 0.6, tilt: 0.45, zoom: 1 };
export const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

export class Orbit {
  // `id`: of the canvas; the button that resets the view is `id`-reset.
  constructor(id) {
    this.canvas = byId(id);
    this.view = { ...START };
    this.pointers = new Map();
    this.listen();
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
    byId(`${canvas.id}-reset`).addEventListener("click", () => this.move(() => Object.assign(this.view, START)));
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
    const width = (canvas.width = canvas.clientWidth * devicePixelRatio);
    const height = (canvas.height = canvas.clientHeight * devicePixelRatio);
    const pen = canvas.getContext("2d");
    pen.clearRect(0, 0, width, height);
    this.paint(pen, width, height);
  }

  // From points with y down and z forward to places on the canvas, and how near they are; all points fit into it.
  projection(points, width, height) {
    const [low, high] = box(points);
    const size = Math.hypot(...high.map((value, k) => value - low[k])) || 1;
    const factor = (0.98 * this.view.zoom * Math.min(width, height)) / size;
    const middle = low.map((value, k) => (value + high[k]) / 2);
    const [c, s] = [Math.cos(this.view.turn), Math.sin(this.view.turn)];
    const [ct, st] = [Math.cos(this.view.tilt), Math.sin(this.view.tilt)];
    const project = (point) => {
      const [a, b, d] = point.map((value, k) => value - middle[k]);
      const across = c * a + s * d;
      const away = -s * a + c * d;
      return [width / 2 + factor * across, height / 2 + factor * (ct * b - st * away), -(st * b + ct * away)];
    };
    return { project, factor };
  }
}

export function line(pen, from, to) {
  pen.beginPath();
  pen.moveTo(from[0], from[1]);
  pen.lineTo(to[0], to[1]);
  pen.stroke();
}

export function dot(pen, [u, v], radius) {
  pen.beginPath();
  pen.arc(u, v, radius, 0, 7);
  pen.fill();
}

export function box(points) {
  const low = [0, 1, 2].map((axis) => Math.min(...points.map((point) => point[axis])));
  const high = [0, 1, 2].map((axis) => Math.max(...points.map((point) => point[axis])));
  return [low, high];
}
