// Plots over pairs and over time, on uPlot.
import { byId, element, text } from "./dom.js";
import { changed, clock, milliseconds, mm, whole } from "./format.js";

const uPlot = window.uPlot;
const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const scheme = matchMedia("(prefers-color-scheme: dark)");

// A plot that fits its place, takes the page's colours, and begins when there is something to show.
class Chart {
  constructor(id, options, empty) {
    this.place = byId(id);
    this.options = options;
    this.data = null;
    this.key = "";
    this.empty = element("div", { className: "empty" }, empty);
    this.place.append(this.empty);
    new ResizeObserver(() => this.fit()).observe(this.place);
    scheme.addEventListener("change", () => this.rebuild());
  }

  // `key` tells options that differ in more than data.
  show(data, key = "") {
    const there = data[0].length > 1;
    this.empty.hidden = there;
    this.data = there ? data : null;
    if (!there || key !== this.key || !this.plot) {
      this.key = key;
      this.rebuild();
    } else {
      this.plot.setData(data);
      this.newest();
    }
  }

  rebuild() {
    this.plot?.destroy();
    this.plot = null;
    if (!this.data) return;
    this.plot = new uPlot({ ...this.options(this.key), ...this.size() }, this.data, this.place);
    this.plot.over.addEventListener("mouseleave", () => this.newest());
    queueMicrotask(() => this.newest()); // after uPlot's own first drawing
  }

  // Where no pointer is, the legend has the newest figures.
  newest() {
    if (this.plot && !this.plot.over.matches(":hover")) this.plot.setLegend({ idx: this.data[0].length - 1 });
  }

  size() {
    const height = Number(getComputedStyle(this.place).getPropertyValue("--height"));
    return { width: this.place.clientWidth, height };
  }

  fit() {
    if (this.plot && this.place.clientWidth > 0) this.plot.setSize(this.size());
  }
}

function axis(label, values) {
  const grid = { stroke: color("--rule"), width: 1 };
  return { stroke: color("--soft"), grid, ticks: grid, label, values, labelSize: label ? 18 : 0, size: 34, font: "12px system-ui", labelFont: "12px system-ui" };
}

function line(label, stroke, value, more = {}) {
  return { label, stroke: color(stroke), width: 2, value: (_, shown) => value(shown), points: { show: false }, spanGaps: false, ...more };
}

// Dashed lines where something changed, with what it was.
function marks(places) {
  return {
    hooks: {
      draw: (plot) => {
        const { ctx, bbox } = plot;
        ctx.save();
        ctx.strokeStyle = ctx.fillStyle = color("--mark");
        ctx.lineWidth = 1.5 * devicePixelRatio;
        ctx.setLineDash([5 * devicePixelRatio, 4 * devicePixelRatio]);
        ctx.font = `${11 * devicePixelRatio}px system-ui`;
        for (const { at, said } of places()) {
          const x = plot.valToPos(at, "x", true);
          if (x < bbox.left || x > bbox.left + bbox.width) continue;
          ctx.beginPath();
          ctx.moveTo(x, bbox.top);
          ctx.lineTo(x, bbox.top + bbox.height);
          ctx.stroke();
          const nearEnd = x > bbox.left + 0.85 * bbox.width;
          ctx.textAlign = nearEnd ? "right" : "left";
          ctx.fillText(said, x + (nearEnd ? -5 : 5) * devicePixelRatio, bbox.top + 12 * devicePixelRatio);
        }
        ctx.restore();
      },
    },
  };
}

const times = (_, values) => values.map(clock);
// Powers of ten with few grid lines, and numbers without needless zeros.
const millimetres = (_, values) => values.map((value) => (value === null ? "" : String(Number((1e3 * value).toPrecision(3)))));
const positive = (values) => values.map((value) => (value > 0 ? value : null));

export class ErrorChart {
  constructor() {
    this.changes = [];
    this.over = "pairs";
    this.chart = new Chart("error-plot", (key) => this.options(key), "No sample was learnt yet");
    for (const choice of document.getElementsByName("axis")) {
      choice.addEventListener("change", () => {
        this.over = choice.value;
        this.render();
      });
    }
  }

  update(state) {
    this.state = state;
    this.changes = state.course?.changes ?? [];
    this.render();
  }

  render() {
    const { learner, series } = this.state ?? {};
    const curve = learner?.status?.curve ?? [];
    if (this.over === "pairs") this.chart.show([curve.map((point) => point[0]), positive(curve.map((point) => point[1]))], "pairs");
    else this.chart.show([series?.t ?? [], positive(series?.error_m ?? []), positive(series?.expected_m ?? [])], "time");
    if (!curve.length) return;
    const [[first, begin], [pairs, error]] = [curve[0], curve.at(-1)];
    const told = this.changes.length ? `; ${this.changes.map((change) => `${changed(change)} after ${whole(change.pairs)}`).join(", ")}` : "";
    text("error-text", `${mm(error)} after ${whole(pairs)} samples, ${mm(begin)} after ${whole(first)}${told}.`);
  }

  options(key) {
    const time = key === "time";
    const series = [
      { label: time ? "time" : "samples", value: (_, shown) => (shown === null ? "–" : time ? clock(shown) : whole(shown)) },
      line("error on new samples", "--line", mm),
    ];
    if (time) series.push(line("expected error", "--second", mm, { dash: [6, 4] }));
    return {
      series,
      scales: { x: { time }, y: { distr: 3 } },
      axes: [time ? { ...axis(undefined, times), space: 70 } : axis("samples learnt"), { ...axis("mm", millimetres), size: 58 }],
      cursor: { drag: { x: true, y: false } },
      plugins: [marks(() => this.changes.map((change) => ({ at: time ? change.t : change.pairs, said: changed(change) })))],
    };
  }
}

export class LatencyChart {
  constructor() {
    this.chart = new Chart("latency-plot", () => this.options(), "No prediction was answered yet");
  }

  update(state) {
    const { t = [], predict_s: took = [] } = state.series ?? {};
    this.chart.show([t, took]);
    const answered = took.filter((value) => value !== null).sort((a, b) => a - b);
    if (!answered.length) return;
    const at = (share) => answered[Math.min(answered.length - 1, Math.floor(share * answered.length))];
    text("latency-text", `Median ${milliseconds(at(0.5))}, 95 % within ${milliseconds(at(0.95))}, worst ${milliseconds(answered.at(-1))}.`);
  }

  options() {
    return {
      series: [{}, line("prediction", "--line", milliseconds)],
      scales: { x: { time: true }, y: { range: (_, least, most) => [0, Math.max(1.15 * (most ?? 0), 2e-3)] } },
      axes: [{ ...axis(undefined, times), space: 70 }, { ...axis("ms", millimetres), size: 58 }],
      legend: { show: false },
      cursor: { drag: { x: false, y: false } },
    };
  }
}
