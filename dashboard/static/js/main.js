// Documents come as server-sent events, each whole under its topic; every panel shows those that it needs.
import { Actions } from "./actions.js";
import { ErrorChart, LatencyChart } from "./charts.js";
import { byId, text } from "./dom.js";
import { notices } from "./notices.js";
import { Picture } from "./picture.js";
import { arm, calibration, cloud, coverage, footer, models, outlook, pills, rejected, segments, suspicions, tiles } from "./panels.js";

const TOPICS = ["robot", "sampler", "learner", "outlook", "series", "course", "segments", "cloud", "arm", "diagnosis"];
// Figures come every second: nothing for so long, and the connection is taken for lost.
const SILENT_MS = 8000;

const state = {};
let connected = false;
let heardAt = 0;
let scheduled = false;

const error = new ErrorChart();
const latency = new LatencyChart();
new Picture();
const actions = new Actions(() => render());
// Views in space by their topics, and what they show.
const spaces = {};
const shown = {};

function render() {
  scheduled = false;
  document.body.classList.toggle("stale", !connected);
  if (state.robot) {
    text("robot", state.robot.robot);
    document.title = `${state.robot.robot} · bodyschema`;
  }
  for (const panel of [tiles, pills, arm, cloud, calibration, outlook, coverage, rejected, segments, suspicions, models, footer]) panel(state);
  error.update(state);
  latency.update(state);
  for (const [topic, space] of Object.entries(spaces)) {
    if (shown[topic] === state[topic]) continue;
    shown[topic] = state[topic];
    space.update(state[topic]);
  }
  notices(state, connected);
  actions.update(state, connected);
}

function schedule() {
  if (scheduled) return;
  scheduled = true;
  requestAnimationFrame(render);
}

function connect() {
  const events = new EventSource("api/events");
  events.onopen = () => setConnected(true);
  events.onerror = () => {
    setConnected(false);
    if (events.readyState === EventSource.CLOSED) setTimeout(connect, 2000); // refused: it does not try again by itself
  };
  for (const topic of TOPICS) {
    events.addEventListener(topic, (event) => {
      state[topic] = JSON.parse(event.data);
      setConnected(true);
    });
  }
}

function setConnected(now) {
  connected = now;
  if (now) heardAt = performance.now();
  schedule();
}

// The rest of the page does not wait for the graphics, nor need them.
async function openSpaces() {
  const probe = document.createElement("canvas").getContext("webgl2");
  probe?.getExtension("WEBGL_lose_context")?.loseContext();
  for (const id of ["arm", "cloud"]) {
    byId(`${id}-none`).hidden = Boolean(probe);
    byId(id).hidden = byId(`${id}-reset`).hidden = !probe;
  }
  if (!probe) return;
  const [{ Arm }, { Cloud }] = await Promise.all([import("./arm.js"), import("./cloud.js")]);
  spaces.arm = new Arm();
  spaces.cloud = new Cloud();
  schedule();
}

setInterval(() => {
  if (connected && performance.now() - heardAt > SILENT_MS) setConnected(false);
}, 1000);
connect();
render();
openSpaces();
