// Plays a pipeline step by step: clouds that move, layers that come and go, and the number that belongs to a step.
// The data stand in the page (<script id="playback" type="application/json">), written by playbacks.py.
import {
  AmbientLight,
  BufferAttribute,
  BufferGeometry,
  Color,
  ColorManagement,
  CylinderGeometry,
  DirectionalLight,
  Group,
  InstancedMesh,
  LinearSRGBColorSpace,
  Matrix4,
  MeshLambertMaterial,
  PerspectiveCamera,
  Points,
  PointsMaterial,
  Quaternion,
  Scene,
  SphereGeometry,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

const MOVE_MS = 900;
const REST_MS = 1500;

ColorManagement.enabled = false;
const data = JSON.parse(document.getElementById("playback").textContent);
const part = (id) => document.getElementById(id);

function bytes(text) {
  return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
}

function pointsOf(layer) {
  const quantised = new Int16Array(bytes(layer.positions));
  const positions = Float32Array.from(quantised, (value, i) => value * layer.unit_mm + layer.centre_mm[i % 3]);
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(positions, 3));
  geometry.setAttribute("color", new BufferAttribute(new Uint8Array(bytes(layer.colours)), 3, true));
  const material = new PointsMaterial({ size: layer.size_mm, vertexColors: true, sizeAttenuation: true });
  return new Points(geometry, material);
}

// Rods from a to b with balls at their ends; rods: rows of x, y, z of a, of b, and the radius.
function rodsOf(layer) {
  const group = new Group();
  const material = new MeshLambertMaterial({ color: layer.colours ? "#ffffff" : layer.colour });
  const rods = new InstancedMesh(new CylinderGeometry(1, 1, 1, 20), material, layer.rods.length);
  const balls = new InstancedMesh(new SphereGeometry(1, 20, 12), material, 2 * layer.rods.length);
  const [up, turn] = [new Vector3(0, 1, 0), new Quaternion()];
  layer.rods.forEach(([ax, ay, az, bx, by, bz, radius], i) => {
    const [a, b] = [new Vector3(ax, ay, az), new Vector3(bx, by, bz)];
    const along = b.clone().sub(a);
    turn.setFromUnitVectors(up, along.clone().normalize());
    const middle = a.clone().add(b).multiplyScalar(0.5);
    rods.setMatrixAt(i, new Matrix4().compose(middle, turn, new Vector3(radius, along.length(), radius)));
    [a, b].forEach((end, k) =>
      balls.setMatrixAt(2 * i + k, new Matrix4().compose(end, new Quaternion(), new Vector3(radius, radius, radius))),
    );
    if (layer.colours) {
      const colour = new Color(layer.colours[i]);
      rods.setColorAt(i, colour);
      [0, 1].forEach((k) => balls.setColorAt(2 * i + k, colour));
    }
  });
  group.add(rods, balls);
  return group;
}

const renderer = new WebGLRenderer({ canvas: part("view"), antialias: true, preserveDrawingBuffer: true });
renderer.outputColorSpace = LinearSRGBColorSpace; // colours stay as they are given
renderer.setClearColor(0xffffff);
const scene = new Scene();
const camera = new PerspectiveCamera(30, 1, 1, 20000);
const light = new DirectionalLight(0xffffff, 1.9);
scene.add(new AmbientLight(0xffffff, 1.3), camera);
camera.add(light);
const controls = new OrbitControls(camera, renderer.domElement);

const moving = new Group();
moving.matrixAutoUpdate = false;
scene.add(moving);
const layers = data.layers.map((layer) => {
  const object = layer.kind === "points" ? pointsOf(layer) : rodsOf(layer);
  (layer.moves ? moving : scene).add(object);
  return { ...layer, object, off: false };
});

const poses = data.steps.map((step) => {
  const [position, turn, scale] = [new Vector3(), new Quaternion(), new Vector3()];
  new Matrix4().set(...step.pose).decompose(position, turn, scale);
  return { position, turn };
});
const views = data.steps.map((step) => {
  const { eye, centre, up } = data.views[step.view];
  return { eye: new Vector3(...eye), centre: new Vector3(...centre), up: new Vector3(...up) };
});

let at = 0; // the step that is shown, or towards which it moves
let from = null; // where the movement began: pose and camera
let began = 0;
let playing = false;
let rest = 0;
let held = false; // the reader has turned the view: it stays until the step asks for another one

function poseNow() {
  const [position, turn, scale] = [new Vector3(), new Quaternion(), new Vector3()];
  moving.matrix.decompose(position, turn, scale);
  return { position, turn, eye: camera.position.clone(), centre: controls.target.clone(), up: camera.up.clone() };
}

function showLayers() {
  const step = data.steps[at];
  layers.forEach((layer, i) => (layer.object.visible = step.layers.includes(i) && !layer.off));
  part("layers").childNodes.forEach((label, i) => label.classList.toggle("absent", !step.layers.includes(i)));
}

function go(step, still = false) {
  if (data.steps[step].view !== data.steps[at].view) held = false;
  at = step;
  from = poseNow();
  began = performance.now() - (still ? MOVE_MS : 0);
  rest = 0;
  part("step").value = String(at);
  const { title, text, number } = data.steps[at];
  part("title").textContent = `${at + 1} of ${data.steps.length}: ${title}`;
  part("text").textContent = text;
  part("number").textContent = number;
  document.body.dataset.step = String(at);
  showLayers();
  ask();
}

function play(on) {
  playing = on;
  part("play").textContent = on ? "❚❚ Pause" : "▶ Play";
  document.body.dataset.playing = String(on);
  ask();
  if (on && at === data.steps.length - 1) go(0);
}

let asked = false; // a picture is drawn only when something has changed
function ask() {
  if (!asked) requestAnimationFrame(draw);
  asked = true;
}

function draw(now) {
  asked = false;
  const done = Math.min((now - began) / MOVE_MS, 1);
  const eased = done * done * (3 - 2 * done);
  if (from) {
    const [goal, view] = [poses[at], views[at]];
    const position = from.position.clone().lerp(goal.position, eased);
    const turn = from.turn.clone().slerp(goal.turn, eased);
    moving.matrix.compose(position, turn, new Vector3(1, 1, 1));
    moving.matrixWorldNeedsUpdate = true;
    if (!held) {
      camera.position.copy(from.eye.clone().lerp(view.eye, eased));
      controls.target.copy(from.centre.clone().lerp(view.centre, eased));
      camera.up.copy(from.up.clone().lerp(view.up, eased).normalize());
    }
    if (done === 1) from = null;
  }
  if (playing && done === 1) {
    rest = rest || now;
    if (now - rest > REST_MS) at < data.steps.length - 1 ? go(at + 1) : play(false);
  }
  controls.update();
  renderer.render(scene, camera);
  if (from || playing) ask();
}

function fit() {
  const { clientWidth: width, clientHeight: height } = part("stage");
  renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
  renderer.setSize(width, height, false);
  camera.aspect = width / Math.max(height, 1);
  camera.fov = 30 * Math.max(1, 1.35 / camera.aspect); // a narrow screen sees as much from side to side
  camera.updateProjectionMatrix();
  ask();
}

layers.forEach((layer) => {
  const label = document.createElement("label");
  const box = Object.assign(document.createElement("input"), { type: "checkbox", checked: true });
  box.addEventListener("change", () => {
    layer.off = !box.checked;
    showLayers();
    ask();
  });
  const swatch = document.createElement("i");
  swatch.style.background = layer.colour;
  label.append(box, swatch, ` ${layer.name}`);
  part("layers").append(label);
});
part("step").max = String(data.steps.length - 1);
part("step").addEventListener("input", (event) => {
  play(false);
  go(Number(event.target.value));
});
part("play").addEventListener("click", () => play(!playing));
part("back").addEventListener("click", () => (play(false), go(Math.max(at - 1, 0))));
part("next").addEventListener("click", () => (play(false), go(Math.min(at + 1, data.steps.length - 1))));
controls.addEventListener("start", () => (held = true));
controls.addEventListener("change", ask);
window.addEventListener("resize", fit);
new ResizeObserver(fit).observe(part("stage"));

camera.position.copy(views[0].eye);
controls.target.copy(views[0].centre);
camera.up.copy(views[0].up);
fit();
go(0, true);
part("caption").textContent = data.caption;
