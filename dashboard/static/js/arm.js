// The robot at its newest pair: links as the URDF has them, the marker as measured and as predicted, and the cameras.
import { byId, text } from "./dom.js";
import { roundDown } from "./format.js";
import { color, disc, lines, named, Space, THREE } from "./space.js";

// Shares of the robot's size: radius of rods, of axes, and length of axes and of what the cameras see.
const ROD = 0.014;
const THIN = 0.0035;
const AXIS = 0.11;
const SEEN = 0.16;
// Sizes on the screen [px].
const DOT = 11;
const RING = 17;
// Nearest to the marker that its button goes [m].
const NEAREST_M = 0.002;

const vector = ([x, y, z]) => new THREE.Vector3(x, y, z);

function put(object, [x, y, z, ...turn]) {
  object.position.set(x, y, z);
  object.quaternion.set(...turn);
}

export class Arm extends Space {
  constructor() {
    super("arm");
    this.renderer.shadowMap.enabled = true;
    this.materials = new Map();
    const sky = new THREE.HemisphereLight(0xffffff, 0x9aa0aa, 1.8);
    this.sun = new THREE.DirectionalLight(0xffffff, 2.2);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(1024, 1024);
    this.sun.shadow.radius = 4;
    const fill = new THREE.DirectionalLight(0xffffff, 0.9);
    fill.position.set(-1, 1, 0.6);
    this.ground = new THREE.Mesh(new THREE.PlaneGeometry(1, 1), new THREE.ShadowMaterial());
    this.ground.receiveShadow = true;
    this.scene.add(sky, this.sun, this.sun.target, fill, this.ground);
    this.marks = this.marker();
    this.paint();
    this.marked = false;
    byId("arm-marker").addEventListener("click", () => this.mark(!this.marked));
    byId("arm-marker").hidden = false;
    this.load();
  }

  async load() {
    text("arm-said", "The robot's shapes are being read.");
    const body = await fetch("api/body").then((answer) => answer.json(), () => null);
    if (body) this.build(body);
    else setTimeout(() => this.load(), 5000); // the page's server has gone; it comes back
  }

  // The material of a color: one of the scheme (`--name`), or what the URDF says.
  material(name, opacity = 1) {
    const key = `${name} ${opacity}`;
    if (!this.materials.has(key)) {
      const made = new THREE.MeshStandardMaterial({ roughness: 0.62, metalness: 0.08, opacity, transparent: opacity < 1 });
      if (name.startsWith("--")) named(made, name);
      else made.color.setStyle(name);
      this.materials.set(key, made);
    }
    return this.materials.get(key);
  }

  paint() {
    super.paint();
    this.ground.material.opacity = matchMedia("(prefers-color-scheme: dark)").matches ? 0.5 : 0.16;
    if (this.grid) this.renewGrid();
  }

  // What shows the marker, in front of everything.
  marker() {
    const on = { depthTest: false, transparent: true };
    const sprite = (name, map) => new THREE.Sprite(named(new THREE.SpriteMaterial({ map, sizeAttenuation: false, ...on }), name));
    const dots = named(new THREE.PointsMaterial({ size: 5, sizeAttenuation: false, map: disc(), vertexColors: true, ...on }), "--mark");
    const line = (name, more) => {
      const made = lines([[0, 0, 0], [0, 0, 0]]);
      Object.assign(named(made.material, name), more);
      return made;
    };
    const marks = {
      tool: line("--soft"),
      trail: new THREE.Points(new THREE.BufferGeometry(), dots),
      ellipsoid: new THREE.Mesh(new THREE.SphereGeometry(1, 48, 32), named(new THREE.MeshBasicMaterial({ opacity: 0.28, ...on }), "--second")),
      apart: line("--second", on),
      measured: sprite("--mark", disc()),
      predicted: sprite("--second", disc(true)),
    };
    Object.values(marks).forEach((mark, k) => {
      Object.assign(mark, { renderOrder: k + 1, visible: false, frustumCulled: false });
      this.scene.add(mark);
    });
    return marks;
  }

  build(body) {
    this.body = body;
    const waiting = [];
    const meshes = new Map();
    this.links = body.shapes.map((shapes) => {
      const link = new THREE.Group();
      for (const shape of shapes) {
        const [r, g, b, opacity] = shape.rgba ?? [];
        const material = shape.rgba ? this.material(`rgb(${[r, g, b].map((value) => Math.round(255 * value))})`, opacity) : this.material("--link");
        const mesh = new THREE.Mesh(primitive(shape), material);
        mesh.castShadow = mesh.receiveShadow = true;
        put(mesh, shape.pose);
        if (shape.mesh !== null) {
          if (!meshes.has(shape.mesh)) meshes.set(shape.mesh, geometryOf(shape.mesh));
          waiting.push(meshes.get(shape.mesh).then((geometry) => (mesh.geometry = geometry)));
        }
        link.add(mesh);
      }
      this.scene.add(link);
      return link;
    });
    const cylinder = new THREE.CylinderGeometry(1, 1, 1, 20).rotateX(Math.PI / 2);
    this.rods = body.rods.map((ends) => {
      const rod = new THREE.Mesh(cylinder, this.material("--link"));
      rod.castShadow = true;
      this.scene.add(rod);
      return { rod, ends };
    });
    const bare = new Set(body.rods.map(([, to]) => to));
    this.joints = body.moving.filter((link) => bare.has(link)).map((link) => {
      const joint = new THREE.Mesh(new THREE.SphereGeometry(1, 24, 16), this.material("--line"));
      joint.castShadow = true;
      this.scene.add(joint);
      return { joint, link };
    });
    this.cameras = new THREE.Group();
    this.scene.add(this.cameras);
    text("arm-said", body.said.join(" "));
    const show = () => {
      this.framed = null;
      if (this.document) this.update(this.document);
    };
    show();
    Promise.allSettled(waiting).then(show);
  }

  update(document) {
    this.document = document;
    if (!document || !this.body) return;
    if (document.links.length !== this.links.length) location.reload(); // the page's server began again with another URDF
    const reached = [document.measured, document.predicted ?? document.measured].map(vector);
    if (!this.framed || reached.some((place) => place.distanceTo(this.center) > 1.05 * this.radius)) this.frameBody();
    this.redraw();
    const { trail, tool, ellipsoid, apart, measured, predicted } = this.marks;
    put(this.cameras, document.camera);
    if (this.cameraLabel) this.cameraLabel.place.copy(vector(document.camera));
    const fade = document.trail.map((_, k) => [1, 1, 1, 0.08 + (0.72 * k) / document.trail.length]);
    trail.geometry.dispose();
    trail.geometry = new THREE.BufferGeometry();
    trail.geometry.setAttribute("position", new THREE.Float32BufferAttribute(document.trail.flat(), 3));
    trail.geometry.setAttribute("color", new THREE.Float32BufferAttribute(fade.flat(), 4));
    measured.position.copy(vector(document.measured));
    measured.visible = trail.visible = tool.visible = true;
    predicted.visible = apart.visible = Boolean(document.predicted);
    ellipsoid.visible = Boolean(document.predicted && document.radii);
    if (document.predicted) {
      predicted.position.copy(vector(document.predicted));
      between(apart, document.predicted, document.measured);
      put(ellipsoid, [...document.predicted, ...document.camera.slice(3)]);
      if (document.radii) ellipsoid.scale.set(...document.radii);
    }
    if (this.marked) this.mark(true);
  }

  // The links' way to where the document has them.
  move(share) {
    if (!this.document || !this.body) return false;
    let rest = 0;
    const turn = new THREE.Quaternion();
    this.document.links.forEach((pose, k) => {
      const link = this.links[k];
      turn.set(...pose.slice(3));
      if (share >= 1 || !this.placed) put(link, pose);
      rest = Math.max(rest, link.position.distanceTo(vector(pose)) / this.radius, link.quaternion.angleTo(turn));
      link.position.lerp(vector(pose), share);
      link.quaternion.slerp(turn, share);
    });
    if (rest < 1e-3) this.document.links.forEach((pose, k) => put(this.links[k], pose));
    this.placed = true;
    between(this.marks.tool, this.links[this.document.hand].position.toArray(), this.document.predicted ?? this.document.measured);
    for (const { rod, ends } of this.rods) span(rod, ...ends.map((link) => this.links[link].position), ROD * this.size);
    for (const { joint, link } of this.joints) {
      joint.position.copy(this.links[link].position);
      joint.scale.setScalar(1.35 * ROD * this.size);
    }
    return rest >= 1e-3;
  }

  keepSizes() {
    this.marks.measured.scale.setScalar(DOT * this.pixel);
    this.marks.predicted.scale.setScalar(RING * this.pixel);
  }

  // Turn the view to the marker, near enough to see what it is wrong by, or back.
  mark(marked) {
    this.marked = marked;
    byId("arm-marker").setAttribute("aria-pressed", marked);
    if (!marked) this.reset();
    else if (this.document) {
      const { measured, predicted, radii, apart_m: apart } = this.document;
      const size = Math.max(NEAREST_M, 3 * (apart ?? 0), ...(radii ?? []).map((radius) => 3 * radius));
      for (const each of [this.goal, this.view]) each.target.copy(vector(predicted ?? measured));
      this.goal.zoom = this.radius / size;
      this.touched = true;
      this.redraw();
    }
  }

  reset() {
    this.marked = false;
    byId("arm-marker").setAttribute("aria-pressed", false);
    super.reset();
  }

  // What depends on the robot's size: the view, light, ground, axes and cameras.
  frameBody() {
    this.placed = false;
    this.size ??= 1;
    this.move(1);
    const box = this.framed ?? new THREE.Box3().expandByPoint(new THREE.Vector3());
    this.framed = box;
    for (const link of this.links) box.expandByPoint(link.position).union(new THREE.Box3().setFromObject(link));
    for (const place of [...this.document.trail, this.document.measured]) box.expandByPoint(vector(place));
    const ball = box.getBoundingSphere(new THREE.Sphere());
    this.size = 2 * ball.radius;
    const eye = vector(this.document.camera);
    // The camera may be far away, or the view narrow: then it does not shrink the arm.
    const shown = eye.distanceTo(ball.center) < (this.eye.aspect < 1 ? 1.5 : 3) * ball.radius ? box.clone().expandByPoint(eye).getBoundingSphere(new THREE.Sphere()) : ball;
    this.fit(shown.center, (eye.distanceTo(ball.center) < ball.radius || shown === ball ? 1 : 0.88) * shown.radius);
    this.low = Math.min(box.min.z, 0);
    this.sun.position.copy(ball.center).add(new THREE.Vector3(-0.25, -1, 1.9).multiplyScalar(ball.radius));
    this.sun.target.position.copy(ball.center);
    this.sun.shadow.normalBias = 0.006 * this.size;
    Object.assign(this.sun.shadow.camera, { left: -1.6 * ball.radius, right: 1.6 * ball.radius, top: 1.6 * ball.radius, bottom: -1.6 * ball.radius, near: 0.01, far: 6 * ball.radius });
    this.sun.shadow.camera.updateProjectionMatrix();
    this.ground.scale.setScalar(12 * this.size);
    this.ground.position.z = this.low - 0.001 * this.size;
    this.renewGrid();
    this.renewAxes();
    this.renewCameras();
  }

  renewGrid() {
    if (this.grid) this.scene.remove(this.grid);
    const step = roundDown(this.size / 7);
    const reach = 16;
    const faded = color("--grid");
    const points = [];
    const colors = [];
    const corner = (a, b) => {
      points.push([a * step, b * step, this.low]);
      colors.push([faded.r, faded.g, faded.b, Math.max(1 - Math.hypot(a, b) / reach, 0)]);
    };
    for (let a = -reach; a <= reach; a++) {
      for (let b = -reach; b < reach; b++) {
        for (const [from, to] of [[[a, b], [a, b + 1]], [[b, a], [b + 1, a]]]) {
          corner(...from);
          corner(...to);
        }
      }
    }
    this.grid = lines(points, colors);
    this.scene.add(this.grid);
  }

  renewAxes() {
    if (this.axes) this.scene.remove(this.axes);
    this.axes = axes(AXIS * this.size, THIN * this.size);
    this.scene.add(this.axes);
  }

  renewCameras() {
    const { cameras, body } = this;
    cameras.clear();
    cameras.add(axes(0.4 * AXIS * this.size, 0.6 * THIN * this.size));
    if (body.camera) {
      const [left, right, top, bottom] = body.camera.edges.map((value) => value * SEEN * this.size);
      const corners = [[left, top], [right, top], [right, bottom], [left, bottom]].map(([x, y]) => [x, y, SEEN * this.size]);
      for (const eye of body.camera.eyes) {
        const placed = corners.map((corner) => corner.map((value, axis) => value + eye[axis]));
        const pyramid = lines(placed.flatMap((corner, k) => [eye, corner, corner, placed[(k + 1) % 4]]));
        named(pyramid.material, "--good");
        cameras.add(pyramid);
      }
    }
    this.cameraLabel ??= this.label("camera");
  }
}

function axes(length, radius) {
  const group = new THREE.Group();
  ["#e5484d", "#30a46c", "#3e7bfa"].forEach((each, axis) => {
    const rod = new THREE.Mesh(new THREE.CylinderGeometry(radius, radius, length, 12).translate(0, length / 2, 0), new THREE.MeshBasicMaterial({ color: each }));
    if (axis === 0) rod.rotateZ(-Math.PI / 2);
    if (axis === 2) rod.rotateX(Math.PI / 2);
    group.add(rod);
  });
  return group;
}

function between(line, from, to) {
  const place = line.geometry.attributes.position;
  place.setXYZ(0, ...from.slice(0, 3));
  place.setXYZ(1, ...to);
  place.needsUpdate = true;
}

// Let a rod of length 1 along z stand between two points.
function span(rod, from, to, radius) {
  const along = to.clone().sub(from);
  const length = along.length();
  rod.visible = length > 1e-4;
  rod.position.copy(from).addScaledVector(along, 0.5);
  if (rod.visible) rod.quaternion.setFromUnitVectors(new THREE.Vector3(0, 0, 1), along.divideScalar(length));
  rod.scale.set(radius, radius, length);
}

function primitive({ kind, sizes }) {
  if (kind === "box") return new THREE.BoxGeometry(...sizes);
  if (kind === "sphere") return new THREE.SphereGeometry(sizes[0], 40, 24);
  if (kind === "cylinder") return new THREE.CylinderGeometry(sizes[0], sizes[0], sizes[1], 48).rotateX(Math.PI / 2);
  if (kind === "capsule") return new THREE.CapsuleGeometry(sizes[0], sizes[1], 12, 32).rotateX(Math.PI / 2);
  return new THREE.BufferGeometry();
}

// A mesh as the page's server sends it (dashboard/shapes.py).
async function geometryOf(number) {
  const answer = await fetch(`api/body/${number}`);
  if (!answer.ok) throw new Error("no mesh");
  const data = await answer.arrayBuffer();
  const [vertices, indices] = new Uint32Array(data, 0, 2);
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(data, 8, 3 * vertices), 3));
  geometry.setAttribute("normal", new THREE.BufferAttribute(new Int8Array(data, 8 + 12 * vertices, 4 * vertices), 4, true));
  geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(data, 8 + 16 * vertices, indices), 1));
  return geometry;
}
