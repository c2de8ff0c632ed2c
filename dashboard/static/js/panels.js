// Tiles, tables and sentences.
import { bar, byId, element, row, text } from "./dom.js";
import { clock, joint, kindOfChange, milliseconds, mm, roundDown, span, whole, words } from "./format.js";

const last = (values) => values?.findLast((value) => value !== null);

export function tiles({ sampler, learner, series }) {
  const status = learner?.status;
  text("tile-error", mm(status?.prequential_m[status.answering]));
  text("tile-expected", mm(series?.expected_m.at(-1)));
  text("tile-pairs", whole(status?.pairs ?? sampler?.status?.pairs));
  text("tile-error-of", status?.prequential_pairs ? `${lastPairs(status)}, each predicted before it was learnt` : "");
  text("tile-expected-of", status?.claimed_error_m ? "the learner's estimate of the same, where data is" : "");
  const since = status && status.pairs_since_change < status.pairs ? [`${whole(status.pairs_since_change)} since the last change`] : [];
  const behind = status?.behind ? [`${whole(status.behind)} stored and not learnt yet`] : [];
  text("tile-pairs-of", [...since, ...behind].join(", "));
  text("tile-rate", sampler?.answers ? sampler.status.pairs_per_s.toFixed(1) : "–");
  text("tile-predict", learner?.answers ? milliseconds(last(series?.predict_s)) : "–");
  text("tile-model", status?.answering ?? "–");
  text("tile-model-label", status?.model ? `answers, version ${status.model.slice(0, 8)}` : "answers");
}

const lastPairs = (status) => `last ${whole(status.prequential_pairs)} samples`;

export function pills({ sampler, learner }) {
  for (const [name, process] of [["sampler", sampler], ["learner", learner]]) {
    const pill = byId(`pill-${name}`);
    const state = process?.answers ? process.status.state : process ? (process.heard ? "gone" : "not there") : "…";
    const health = process?.status?.health ?? [];
    const calm = ["paused", "ended", "waiting", "aligning"].includes(state) || health.length > 0;
    pill.className = `pill ${!process ? "" : !process.answers || state === "failed" ? "bad" : calm ? "warn" : "good"}`;
    pill.querySelector("b").textContent = state;
  }
}

export function outlook({ outlook: found }) {
  text("outlook", found ? found.sentence : "Not known yet: the learner finds it some time after its first solution with the present tool.");
  const table = byId("forecast");
  table.hidden = !found;
  if (!found) return;
  const differs = found.best_motion_m.some((error, k) => error !== found.like_so_far_m[k]);
  table.tHead.replaceChildren(row(element("th", {}, ""), ...[`after ${whole(found.pairs)} samples`, ...found.further_pairs.map((pairs) => `+${pairs} samples`)].map((name) => element("th", { scope: "col" }, name))));
  const rows = [row("as so far", mm(found.now_m), ...found.like_so_far_m.map(mm))];
  if (differs) {
    rows.push(row(found.best_motion, mm(found.now_m), ...found.best_motion_m.map(mm)));
    rows[1].className = "best";
  }
  table.tBodies[0].replaceChildren(...rows);
}

export function arm({ arm: found }) {
  if (!found) return;
  const apart = found.apart_m === null ? "no model answers" : `prediction and measurement are ${mm(found.apart_m)} apart`;
  const sure = found.radii ? `; 95 % of measurements should lie in the ellipsoid around the prediction, at most ${mm(Math.max(...found.radii))} away` : "";
  caption("arm", `Sample ${found.pair}: ${apart}${sure}.${found.placed ? "" : " The camera's pose is not known yet: the marker is drawn at robot.toml's guess."}`);
}

export function cloud({ cloud: found }) {
  const shown = found && found.x.length > 0;
  text("cloud-stretch", String(shown ? stretchOf(found) : 100));
  caption("cloud", shown ? `${found.x.length} samples with this tool, all learnt already: median ${mm(found.median_m)}, 95 % within ${mm(found.p95_m)}.` : "No residuals yet");
}

function caption(id, said) {
  text(`${id}-text`, said);
  byId(id).setAttribute("aria-label", said);
}

export function box(points) {
  const low = [0, 1, 2].map((axis) => Math.min(...points.map((point) => point[axis])));
  const high = [0, 1, 2].map((axis) => Math.max(...points.map((point) => point[axis])));
  return [low, high];
}

// 1, 2 or 5 times a power of ten, so that most residuals are a twelfth of the box.
export function stretchOf({ x, p95_m: residual }) {
  const [low, high] = box(x);
  const wanted = Math.hypot(...high.map((value, k) => value - low[k])) / 12 / Math.max(residual, 1e-9);
  return roundDown(Math.max(wanted, 1));
}

// Nominal and learnt figures with their intervals; what no motion shows is said below.
export function calibration({ learner, robot }) {
  const found = learner?.status?.calibration;
  byId("calibration").hidden = !found;
  if (!found) {
    text("calibration-text", "Not known yet: it comes with the first solution with the present tool.");
    return;
  }
  const rows = [];
  const figure = (name, unit, digits, factor, { drawn, learnt, half_width: half }) => rows.push(
    row(name, ...[drawn, learnt].map((value) => `${signed(factor * value, digits)} ${unit}`), `${(factor * half).toFixed(digits)} ${unit}`),
  );
  const degree = 180 / Math.PI;
  found.camera_xyz.forEach((each, k) => figure(`camera ${"xyz"[k]}`, "mm", 1, 1e3, each));
  found.camera_rpy.forEach((each, k) => figure(`camera ${["roll", "pitch", "yaw"][k]}`, "°", 2, degree, each));
  found.marker_xyz.forEach((each, k) => figure(`marker ${"xyz"[k]}`, "mm", 1, 1e3, each));
  const hidden = [];
  for (const [name, zero] of Object.entries(found.zeros)) {
    const slides = robot?.slides.includes(name);
    if (zero) figure(`offset ${name}`, slides ? "mm" : "°", 2, slides ? 1e3 : degree, { drawn: 0, learnt: zero.value, half_width: zero.half_width });
    else hidden.push(name);
  }
  const kept = hidden.length ? ` Kept at nominal, because no motion shows the offset: ${hidden.join(", ")}.` : "";
  text("calibration-text", `Of ${whole(found.pairs)} samples: camera in ${found.camera_link}, marker in ${found.marker_link}, joint offsets to add to readings.${kept}`);
  byId("calibration").tBodies[0].replaceChildren(...rows);
}

const signed = (value, digits) => `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(digits)}`;

// The joints that the best motion names, unless it is no better than going on.
function movedNext(found, joints) {
  if (!found || found.best_motion_m.every((error, k) => error === found.like_so_far_m[k])) return new Set();
  const named = new Set(found.best_motion.split(/[\s,]+/));
  const some = joints.filter((name) => named.has(name));
  return new Set(some.length ? some : joints);
}

export function coverage({ sampler, outlook: found, robot }) {
  const ranges = Object.entries(sampler?.status?.coverage ?? {});
  const next = movedNext(found, ranges.map(([name]) => name));
  const items = ranges.map(([name, range]) => {
    const slides = robot?.slides.includes(name);
    const width = range.upper_limit - range.lower_limit || 1;
    const share = (value) => Math.min(Math.max((value - range.lower_limit) / width, 0), 1);
    const [from, to] = [share(range.low), share(range.high)];
    const seen = `${joint(range.low, slides)} … ${joint(range.high, slides)}`;
    const ends = [["", joint(range.lower_limit, slides)], ["seen", seen], ["", joint(range.upper_limit, slides)]];
    return element(
      "li", { className: next.has(name) ? "next" : "" },
      element("span", { className: "name", title: name }, name), bar(from, to, true),
      element("span", { className: "share" }, `${Math.round(100 * (to - from))} %`),
      element("span", { className: "ends" }, ...ends.map(([kind, value]) => element("span", { className: kind }, value))),
    );
  });
  byId("coverage").replaceChildren(...items);
}

export function rejected({ sampler }) {
  const status = sampler?.status;
  const reasons = Object.entries(status?.rejected ?? {}).sort((a, b) => b[1] - a[1]);
  const total = reasons.reduce((sum, [, count]) => sum + count, 0);
  text("frames", status ? `${whole(total)} of ${whole(status.frames)} frames since the sampler started.` : "");
  byId("rejected").hidden = !reasons.length;
  const rows = reasons.map(([reason, count]) => row(words(reason), barCell(count / reasons[0][1]), whole(count), `${((100 * count) / Math.max(status.frames, 1)).toFixed(1)} %`));
  byId("rejected").tBodies[0].replaceChildren(...rows);
}

export function segments({ segments: found }) {
  const newest = [...(found ?? [])].reverse();
  const most = Math.max(1, ...newest.map((segment) => segment.pairs));
  const rows = newest.map((segment, k) => {
    const made = row(String(segment.segment), `${segment.complete ? "" : "≥ "}${whole(segment.pairs)}`, barCell(segment.pairs / most), segment.pairs > 1 ? span(segment.lasted_s) : "–", clock(Date.parse(segment.utc) / 1e3));
    if (k === 0) made.className = "now";
    return made;
  });
  byId("segments").tBodies[0].replaceChildren(...rows);
}

// What the last change was, while more than one kind is probable.
export function suspicions({ learner }) {
  const probable = Object.entries(learner?.status?.last_change?.probabilities ?? {}).sort((a, b) => b[1] - a[1]);
  const open = probable.length > 1 && probable[0][1] < 0.95;
  byId("suspicions").hidden = !open;
  byId("suspicions").replaceChildren(...(open ? probable.map(([kind, probability]) => element("li", {}, `${kindOfChange(kind)}: ${Math.round(100 * probability)} %`)) : []));
}

export function models({ learner, course }) {
  const versions = [...(course?.versions ?? [])].reverse();
  byId("versions").tBodies[0].replaceChildren(...versions.map((version, k) => {
    const pairs = version.first_pairs === version.pairs ? whole(version.pairs) : `${whole(version.first_pairs)}–${whole(version.pairs)}`;
    const named = `${version.answering}${version.after_change ? ", after a change" : ""}`;
    const made = row(clock(version.since), named, pairs, mm(version.error_m), element("td", {}, element("code", {}, version.model.slice(0, 8))));
    if (k === 0) made.className = "now";
    return made;
  }));
  const status = learner?.status;
  const errors = Object.entries(status?.prequential_m ?? {}).sort((a, b) => a[1] - b[1]);
  text("models-of", errors.length ? `Error of each on the ${lastPairs(status)}, the same for all, predicted before they were learnt` : "");
  const worst = Math.max(1e-12, ...errors.map(([, error]) => error));
  byId("models").hidden = !errors.length;
  byId("models").tBodies[0].replaceChildren(...errors.map(([name, error]) => {
    const made = row(name, barCell(error / worst), mm(error));
    if (name === status.answering) made.className = "now";
    return made;
  }));
}

export function footer({ robot, sampler, learner }) {
  const versions = [robot && `page ${robot.version}`, sampler?.status && `sampler ${sampler.status.version}`, learner?.status && `learner ${learner.status.version}`];
  const store = sampler?.status?.store;
  text("footer", [...versions.filter(Boolean), store && `store ${store}`].filter(Boolean).join(" · "));
}

function barCell(share) {
  return element("td", { className: "wide" }, bar(0, share));
}
