// A view in space that is turned by hand, and drawn only when something has changed and it is in sight.
import * as THREE from "../vendor/three.module.min.js";
import { byId } from "./dom.js";
import { roundDown } from "./format.js";

const STEP = 0.12;
const START = { turn: -0.75, tilt: 0.38, zoom: 1 };
const SIGHT = { turn: -Math.PI / 2 + 0.6, tilt: 0.35, zoom: 1 };
const FIELD = (30 * Math.PI) / 180;
// Time in which two thirds of a turn, a zoom or a motion of the arm are done.
const EASE_MS = 90;
const still = matchMedia("(prefers-reduced-motion: reduce)");

export const color = (name) => new THREE.Color(getComputedStyle(document.documentElement).getPropertyValue(name).trim());

// Let a material have a color of the page; it follows the scheme.
export function named(material, name) {
  material.name = name;
  material.color.copy(color(name));
  return material;
}

export class Space {
  // `id`: of the canvas; the button that resets the view is `id`-reset. z is up in the scene.
  constructor(id, upright = true) {
    this.canvas = byId(id);
    this.start = upright ? START : SIGHT;
    this.renderer = new THREE.WebGLRenderer({ canvas: this.canvas, antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.scene = new THREE.Scene();
    this.eye = new THREE.PerspectiveCamera((FIELD * 180) / Math.PI, 1, 0.01, 1000);
    this.eye.up.set(0, 0, 1);
    this.center = new THREE.Vector3();
    this.radius = 1;
    this.goal = { ...this.start, target: this.center.clone() };
    this.view = { ...this.goal, target: this.center.clone() };
    this.labels = [];
    this.pointers = new Map();
    this.inSight = false;
    this.bar = document.createElement("span");
    this.bar.className = "bar-of-scale";
    this.canvas.after(this.bar);
    this.listen();
  }

  listen() {
    const { canvas } = this;
    new ResizeObserver(() => this.resize()).observe(canvas);
    new IntersectionObserver(([entry]) => {
      this.inSight = entry.isIntersecting;
      this.redraw();
    }).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
      this.paint();
      this.redraw();
    });
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    canvas.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && document.activeElement !== canvas) return; // the page scrolls
      event.preventDefault();
      this.touched = true;
      this.zoom(Math.exp(-0.002 * event.deltaY));
    }, { passive: false });
    byId(`${canvas.id}-reset`).addEventListener("click", () => this.reset());
  }

  key(event) {
    const moves = {
      ArrowLeft: () => (this.goal.turn -= STEP),
      ArrowRight: () => (this.goal.turn += STEP),
      ArrowUp: () => (this.goal.tilt += STEP),
      ArrowDown: () => (this.goal.tilt -= STEP),
      "+": () => this.zoom(1.2),
      "=": () => this.zoom(1.2),
      "-": () => this.zoom(1 / 1.2),
      0: () => this.reset(),
    };
    if (!moves[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    this.touched = true;
    moves[event.key]();
    this.redraw();
  }

  drag(event) {
    const last = this.pointers.get(event.pointerId);
    if (!last) return;
    this.touched = true;
    const now = [event.clientX, event.clientY];
    const [across, down] = [now[0] - last[0], now[1] - last[1]];
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
    this.pointers.set(event.pointerId, now);
    const apart = (from) => Math.hypot(from[0] - other[0], from[1] - other[1]);
    if (other) this.zoom(apart(now) / Math.max(apart(last), 1));
    else if (event.shiftKey || event.buttons > 1) this.pan(across, down);
    else {
      this.goal.turn -= 0.008 * across;
      if (event.pointerType === "mouse") this.goal.tilt += 0.008 * down;
    }
    this.redraw();
  }

  pan(across, down) {
    const metres = (2 * this.distance(this.goal) * Math.tan(FIELD / 2)) / this.canvas.clientHeight;
    const [x, y] = [0, 1].map((column) => new THREE.Vector3().setFromMatrixColumn(this.eye.matrixWorld, column));
    this.goal.target.addScaledVector(x, -metres * across).addScaledVector(y, metres * down);
  }

  zoom(factor) {
    this.goal.zoom = Math.min(Math.max(this.goal.zoom * factor, 0.2), 4000);
    this.redraw();
  }

  reset() {
    this.touched = false;
    Object.assign(this.goal, this.start);
    this.goal.target.copy(this.center);
    this.redraw();
  }

  // Let the start of the view show this ball; a view that somebody turned stays.
  fit(center, radius) {
    const scale = radius / this.radius;
    this.center.copy(center);
    for (const each of [this.goal, this.view]) each.zoom *= scale; // the distance stays
    this.radius = radius;
    if (!this.touched) this.reset();
    if (this.fitted) return;
    this.fitted = true;
    Object.assign(this.view, this.goal, { target: this.view.target.copy(center) });
  }

  distance({ zoom }) {
    return this.radius / Math.sin(FIELD / 2) / zoom / Math.min(1, this.eye.aspect);
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.eye.aspect = width / height;
    this.redraw();
  }

  redraw() {
    if (this.inSight && !this.waiting) this.waiting = requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    this.waiting = null;
    const passed = Math.min(now - (this.drawnAt ?? now), 50) || 16;
    this.drawnAt = now;
    const share = still.matches ? 1 : 1 - Math.exp(-passed / EASE_MS);
    const { view, goal } = this;
    goal.tilt = Math.min(Math.max(goal.tilt, -1.5), 1.5);
    let rest = 0;
    for (const name of ["turn", "tilt"]) {
      view[name] += share * (goal[name] - view[name]);
      rest = Math.max(rest, Math.abs(goal[name] - view[name]));
    }
    view.zoom *= (goal.zoom / view.zoom) ** share;
    rest = Math.max(rest, Math.abs(Math.log(goal.zoom / view.zoom)), view.target.distanceTo(goal.target) / this.distance(view));
    view.target.lerp(goal.target, share);
    const moves = this.move(share);
    const done = rest < 1e-3 && !moves;
    if (done) Object.assign(view, goal, { target: view.target.copy(goal.target) });
    this.look();
    this.renderer.render(this.scene, this.eye);
    this.place();
    if (!done) this.redraw();
    else this.drawnAt = null;
  }

  look() {
    const { turn, tilt, target } = this.view;
    const away = this.distance(this.view);
    this.eye.position.set(Math.cos(tilt) * Math.cos(turn), Math.cos(tilt) * Math.sin(turn), Math.sin(tilt)).multiplyScalar(away).add(target);
    this.eye.lookAt(target);
    this.eye.near = away / 100;
    this.eye.far = away + 40 * this.radius;
    this.eye.updateProjectionMatrix();
    this.eye.updateMatrixWorld();
    // Size in the scene of a pixel at a distance of 1, for what keeps its size on the screen.
    this.pixel = (2 * Math.tan(FIELD / 2)) / Math.max(this.canvas.clientHeight, 1);
    this.keepSizes?.();
  }

  // Words at places in the scene.
  label(text, place = new THREE.Vector3()) {
    const element = document.createElement("span");
    element.className = "label";
    element.hidden = true;
    element.textContent = text;
    this.canvas.after(element);
    const label = { element, place };
    this.labels.push(label);
    return label;
  }

  place() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const pixel = this.pixel * this.distance(this.view);
    const length = roundDown(140 * pixel);
    this.bar.style.width = `${length / pixel}px`;
    this.bar.textContent = length >= 1 ? `${length} m` : length >= 0.01 ? `${Math.round(100 * length)} cm` : `${Number((1e3 * length).toPrecision(1))} mm`;
    for (const { element, place } of this.labels) {
      const { x, y, z } = place.clone().project(this.eye);
      element.hidden = Math.abs(x) > 0.98 || Math.abs(y) > 0.96 || z > 1;
      const across = ((x + 1) / 2) * width;
      element.style.transform = `translate(${x > 0.7 ? across - 6 - element.offsetWidth : across + 6}px, ${((1 - y) / 2) * height - 20}px)`;
    }
  }

  // What subclasses animate: true while it goes on. `share`: of the way that is left.
  move() {
    return false;
  }

  paint() {
    this.scene.traverse(({ material }) => material?.name.startsWith("--") && named(material, material.name));
  }
}

// Lines between pairs of points, of one color or with one (r, g, b, a) for each point.
export function lines(points, colors) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(points.flat(), 3));
  if (colors) geometry.setAttribute("color", new THREE.Float32BufferAttribute(colors.flat(), 4));
  return new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ transparent: true, vertexColors: Boolean(colors) }));
}

// A picture of a disc, or of a ring.
export function disc(ring = false) {
  const canvas = Object.assign(document.createElement("canvas"), { width: 64, height: 64 });
  const pen = canvas.getContext("2d");
  pen.strokeStyle = pen.fillStyle = "#fff";
  pen.lineWidth = 10;
  pen.beginPath();
  pen.arc(32, 32, ring ? 26 : 30, 0, 7);
  if (ring) pen.stroke();
  else pen.fill();
  return new THREE.CanvasTexture(canvas);
}

export { THREE };
