"use strict";
/* --- charts --- */

const decades = (u, axis, low, high) =>
  [-10, -1, -0.1, -0.01, 0, 0.01, 0.1, 1, 10].filter((one) => low <= one && one <= high);
const CHARTS = [
  { of: "lost", title: "time lost to the reference", unit: "ms" },
  { of: "v", title: "speed", unit: "m/s" },
  { of: "d", title: "drive command", unit: "" },
  { of: "delta", title: "steering angle", unit: "rad" },
  { of: "slip_deg", title: "slip angle of the body", unit: "°" },
  {
    of: "aside_m",
    title: "distance from the racing line",
    unit: "m, positive to the left",
  },
  {
    of: "error_mm",
    title: "distance from the plan of 0.1 s before",
    unit: "mm; band: the tube in which the car was to be",
    band: "band_mm",
  },
  {
    of: "omega_error",
    title: "error of the model in one step: yaw rate",
    unit: "rad/s, logarithmic beyond 0.01; band: where the Gaussian process expects 95 %",
    band: "omega_band",
    scale: { distr: 4, asinh: 0.01 },
    axis: { splits: decades, filter: (u, ticks) => ticks },
  },
  {
    of: "pace",
    title: "speed that the model's uncertainty leaves",
    unit: "share of the line's",
  },
  { of: "tube_m", title: "tube at the end of the plan", unit: "m to either side" },
  { of: "solve_us", title: "computing time of the step", unit: "µs", log: true },
  { of: "answer_ms", title: "state to actuation", unit: "ms", log: true },
  {
    of: "level",
    title: "fallback",
    unit: "0 solution, 1 shifted plan, 2 braking, 3 stop",
    stepped: true,
  },
];

function buildCharts() {
  for (const plot of plots) plot.chart.destroy();
  plots = [];
  hover = null;
  el("charts").replaceChildren();
  const some = shown();
  if (!some.length) return;
  const sync = uPlot.sync("place"),
    grid = { stroke: css("--line"), width: 1 },
    axis = { stroke: css("--muted"), grid, ticks: grid, font: "11px sans-serif" };
  for (const kind of CHARTS) {
    if (!varies(kind, some)) continue;
    const box = document.createElement("div"),
      head = document.createElement("h2");
    head.append(
      kind.title + " ",
      Object.assign(document.createElement("small"), { textContent: kind.unit }),
    );
    box.append(head);
    el("charts").append(box);
    const lines = [],
      bands = [];
    some.forEach((run, i) => {
      lines.push({
        label: run.label,
        stroke: paint(run),
        dash: run.dash,
        width: 1.5,
        points: { show: false },
        spanGaps: false,
        paths: kind.stepped ? uPlot.paths.stepped({ align: 1 }) : undefined,
      });
      if (kind.band)
        lines.push(
          ...[1, 2].map(() => ({ stroke: paint(run), width: 0.4, points: { show: false } })),
        );
      if (kind.band) bands.push({ series: [3 * i + 3, 3 * i + 2], fill: paint(run) + "22" });
    });
    const chart = new uPlot(
      {
        width: box.clientWidth - 20,
        height: 190,
        bands,
        series: [{}, ...lines],
        legend: { show: false },
        scales: {
          x: { time: false },
          y: kind.log ? { distr: 3 } : { range: () => range(kind), ...kind.scale },
        },
        axes: [
          {
            ...axis,
            label: course.length ? "distance s [m]" : "time [s]",
            labelSize: 16,
            labelFont: "11px sans-serif",
            size: 30,
          },
          { ...axis, size: 52, ...kind.axis },
        ],
        cursor: {
          sync: { key: sync.key, setSeries: false },
          drag: { x: true, y: false },
          y: false,
          points: { size: 6 },
          focus: { prox: -1 },
        },
        hooks: {
          draw: [nameSectors],
          setCursor: [(u) => hovered(u)],
          ready: [(u) => u.over.addEventListener("click", () => goTo(u))],
        },
      },
      data(kind, some),
      box,
    );
    chart.over.addEventListener("mouseleave", () => {
      hover = null;
      dirty.map = true;
    });
    plots.push({ kind, chart, box });
  }
  setTimeout(() => (dirty.map = true)); // charts know their places after this
}

// Whether a chart has anything to say: a fallback that is 0 all along has not.
function varies(kind, some) {
  const values = some.flatMap((run) => series(run, kind.of)).filter((one) => one !== null);
  return kind.of === "level"
    ? values.some((one) => one !== 0)
    : values.length > 0 && max(values) > min(values);
}

function nameSectors(u) {
  if (!course.length) return;
  const pen = u.ctx,
    ratio = devicePixelRatio || 1;
  pen.save();
  pen.fillStyle = css("--muted");
  pen.font = `${10 * ratio}px sans-serif`;
  pen.textAlign = "center";
  for (let k = 0; k < SECTORS; k++) {
    const x = u.valToPos(((k + 0.5) / SECTORS) * length(), "x", true);
    if (x > u.bbox.left && x < u.bbox.left + u.bbox.width)
      pen.fillText("S" + (k + 1), x, u.bbox.top - 2 * ratio);
  }
  pen.restore();
}

// Of the vertical axis: a lap that has ended off the track leaves the picture, so that the others remain legible.
function range(kind) {
  if (kind.of === "level") return [-0.1, 3.1];
  const some = shown(),
    done = some.filter((run) => lapOf(run).done || !run.text),
    names = kind.scale ? [kind.of, kind.band] : [kind.of],
    values = (done.length && !kind.scale ? done : some)
      .flatMap((run) => names.flatMap((name) => series(run, name)))
      .filter((one) => one !== null);
  const low = min(values),
    high = max(values),
    room = 0.06 * (high - low) || 0.05 * Math.abs(high) || 1;
  const most = 1.2 * Math.max(-low, high, 0.01);
  if (kind.scale) return [-most, most];
  return values.length ? [low - room, high + room] : [0, 1];
}

const series = (run, name) => (name === "lost" ? lost(run) : lapOf(run).grid[name]);

function data(kind, some) {
  const L = length(),
    x = Array.from({ length: GRID + 1 }, (_, g) => (g / GRID) * L);
  return [
    x,
    ...some.flatMap((run) => {
      const own = series(run, kind.of);
      if (!kind.band) return [own];
      const band = series(run, kind.band);
      return [own, band.map((b) => (b === null ? null : -b)), band];
    }),
  ];
}

let laid = "";
function drawCharts() {
  const layout = JSON.stringify([
    shown().map((run) => run.key),
    course.length,
    el("view").dataset.theme,
    CHARTS.map((kind) => varies(kind, shown())),
  ]);
  if (layout !== laid) {
    laid = layout;
    buildCharts();
    return;
  }
  const some = shown();
  for (const { kind, chart } of plots) {
    const whole = chart.scales.x.max - chart.scales.x.min > 0.999 * length();
    chart.setData(data(kind, some), whole);
    if (!whole) chart.redraw(); // a zoomed chart keeps its place
  }
}

function hovered(u) {
  if (!u.cursor.event || u.cursor.idx === undefined) return;
  hover = u.cursor.left < 0 ? null : u.cursor.idx;
  dirty.map = true;
}

function goTo(u) {
  const run = active(),
    lap = run && lapOf(run),
    time = lap && u.cursor.idx !== null ? lap.time[u.cursor.idx] : null;
  if (time !== null && time !== undefined) {
    setTime(time);
    remember();
  }
}
