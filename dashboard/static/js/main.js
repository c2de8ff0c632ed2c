// Documents come as server-sent events, each whole under its topic; every panel shows those that it needs.
import { Actions } from "./actions.js";
import { ErrorChart, LatencyChart } from "./charts.js";
import { Arm } from "./arm.js";
import { Cloud } from "./cloud.js";
import { text } from "./dom.js";
import { notices } from "./notices.js";
import { Picture } from "./picture.js";
import { calibration, coverage, footer, models, outlook, pills, rejected, segments, suspicions, tiles } from "./panels.js";

const TOPICS = ["robot", "sampler", "learner", "outlook", "series", "course", "segments", "cloud", "arm", "diagnosis"];
// Figures come every second: nothing for so long, and the connection is taken for lost.
const SILENT_MS = 8000;

const state = {};
let connected = false;
let heardAt = 0;
let scheduled = false;

const error = new ErrorChart();
const latency = new LatencyChart();
const cloud = new Cloud();
const arm = new Arm();
new Picture();
const actions = new Actions(() => render());
let cloudShown = null;
let armShown = null;

function render() {
  scheduled = false;
  document.body.classList.toggle("stale", !connected);
  if (state.robot) {
    text("robot", state.robot.robot);
    document.title = `${state.robot.robot} · bodyschema`;
  }
  for (const panel of [tiles, pills, calibration, outlook, coverage, rejected, segments, suspicions, models, footer]) panel(state);
  error.update(state);
  latency.update(state);
  if (cloudShown !== state.cloud) {
    cloudShown = state.cloud;
    cloud.update(state.cloud);
  }
  if (armShown !== state.arm) {
    armShown = state.arm;
    arm.update(state.arm);
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

setInterval(() => {
  if (connected && performance.now() - heardAt > SILENT_MS) setConnected(false);
}, 1000);
connect();
render();
