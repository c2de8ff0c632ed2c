// Residuals in space.
import { color, disc, lines, named, Space, THREE } from "./space.js";
import { box, stretchOf } from "./panels.js";

export class Cloud extends Space {
  constructor() {
    super("cloud", false);
    // The measurement frame has y down and z forward.
    this.content = new THREE.Group();
    this.content.rotation.x = -Math.PI / 2;
    this.scene.add(this.content);
    this.dot = disc();
    this.corners = ["x", "y", "z"].map((name) => Object.assign(this.label(""), { name }));
  }

  update(document) {
    this.document = document;
    this.paint();
    this.redraw();
  }

  paint() {
    for (const part of this.content.children) part.geometry.dispose();
    this.content.clear();
    if (!this.document?.x.length) return;
    const { x, residual, segment } = this.document;
    const stretch = stretchOf(this.document);
    const newest = segment.at(-1);
    const shade = (name, alpha) => [...color(name).toArray(), alpha];
    const ends = x.flatMap((point, k) => [point, point.map((value, axis) => value - stretch * residual[k][axis])]);
    const second = [shade("--second", 0.5), shade("--second", 1)];
    this.content.add(lines(ends, ends.map((_, k) => second[Number(segment[k >> 1] === newest)])));
    this.content.add(this.points(x.filter((_, k) => segment[k] !== newest), "--line", 4));
    this.content.add(this.points(x.filter((_, k) => segment[k] === newest), "--mark", 6));
    this.frameBox(...box(x));
  }

  points(places, name, size) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(places.flat(), 3));
    return new THREE.Points(geometry, new THREE.PointsMaterial({ size, sizeAttenuation: false, map: this.dot, alphaTest: 0.5, color: color(name) }));
  }

  frameBox(low, high) {
    const corner = (k) => [0, 1, 2].map((axis) => ((k >> axis) & 1 ? high[axis] : low[axis]));
    const edges = [];
    for (let k = 0; k < 8; k++) {
      for (const axis of [1, 2, 4]) if (!(k & axis)) edges.push(corner(k), corner(k | axis));
    }
    const frame = lines(edges);
    named(frame.material, "--grid");
    this.content.add(frame);
    this.content.updateMatrixWorld();
    const place = (point) => this.content.localToWorld(new THREE.Vector3(...point));
    this.corners.forEach(({ element, place: at, name }, axis) => {
      element.textContent = `${name} ${(high[axis] - low[axis]).toFixed(2)} m`;
      at.copy(place(corner(0).map((value, k) => (k === axis ? (low[k] + high[k]) / 2 : value))));
    });
    const middle = place(low.map((value, k) => (value + high[k]) / 2));
    // What grows by a hair with each pair does not move the view.
    const radius = 0.5 * Math.hypot(...high.map((value, k) => value - low[k])) || 1;
    if (!this.fitted || Math.abs(radius - this.radius) > 0.1 * this.radius) this.fit(middle, radius);
  }
}
