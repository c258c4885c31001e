"use strict";
/* --- map --- */

// In pixels from the map's middle.
const pen = el("map").getContext("2d");
let scale = 1, // pixels of a metre
  middle = [0, 0]; // the place there [m]
const px = (x, y) => [scale * (x - middle[0]), scale * (middle[1] - y)];

// The way through places [m].
function way(xs, ys, close) {
  const path = new Path2D();
  xs.forEach((x, i) => path.lineTo(...px(x, ys[i])));
  if (close) path.closePath();
  return path;
}

function stroke(path, colour, width, dash = []) {
  pen.strokeStyle = colour;
  pen.lineWidth = width;
  pen.setLineDash(dash);
  pen.stroke(path);
}

function fill(path, colour, opacity = 1, rule = "nonzero") {
  pen.fillStyle = colour;
  pen.globalAlpha = opacity;
  pen.fill(path, rule);
  pen.globalAlpha = 1;
}

function drawMap() {
  const canvas = pen.canvas,
    wide = canvas.clientWidth,
    ratio = devicePixelRatio || 1,
    pad = 22;
  const points = course.right
    ? [course.right, course.left]
    : [...runs.values()].map((run) => [run.rows.x, run.rows.y]);
  const all = [0, 1].map((c) => points.flatMap((one) => one[c]));
  if (!all[0].length || !wide) return;
  const size = all.map((one) => max(one) - min(one) || 1);
  const tall = Math.min(
    Math.max(220, (wide * size[1]) / size[0]),
    640,
    0.7 * Math.max(innerHeight, 500),
  );
  canvas.width = wide * ratio;
  canvas.height = tall * ratio;
  canvas.style.height = tall + "px";
  pen.setTransform(ratio, 0, 0, ratio, (ratio * wide) / 2, (ratio * tall) / 2);
  scale = Math.min((wide - 2 * pad) / size[0], (tall - 2 * pad) / size[1]);
  middle = all.map((one) => (min(one) + max(one)) / 2);
  const main = active(),
    at = main && rowAt(main);
  if (choice.zoom && at) {
    scale *= 4;
    middle = [value(main, "x", at), value(main, "y", at)];
  }
  if (course.right) drawTrack();
  if (course.line) stroke(way(...course.line, true), css("--muted"), 0.7, [5, 4]);
  const some = shown();
  for (const run of some.filter((one) => one !== main)) {
    const { first, last } = lapOf(run),
      { x, y } = run.rows;
    stroke(way(x.slice(first, last + 1), y.slice(first, last + 1)), paint(run), 1.1, run.dash);
  }
  const loss = main && lapOf(main) ? lossOnEachMetre(main) : null;
  if (loss) drawLoss(main, loss);
  if (at) drawPlan(main, at.row);
  for (const run of some) drawCar(run, rowAt(run), run === main);
  sayLegend(main, loss);
}

// What the map's colours say, in words.
function sayLegend(main, loss) {
  const ref = reference();
  let text = "";
  if (loss) {
    text = `${main.label}: the thick line is its path, the thin one ahead of the car its plan, in the tube where the car may be.`;
    if (ref && ref !== main)
      text += ` Red: loses ${number(loss.size, 1)} ms or more on a metre to ${ref.label}; blue: gains; grey: neither.`;
  }
  say(el("legend"), text);
}

// A run's colour, made lighter where the page is dark.
function paint(run) {
  if (!dark()) return run.colour;
  const parts = [1, 3, 5].map((i) => parseInt(run.colour.slice(i, i + 2), 16)),
    bright = (0.3 * parts[0] + 0.6 * parts[1] + 0.1 * parts[2]) / 255,
    share = Math.max(0, 0.62 - bright),
    lighter = (one) => Math.round(one + share * (255 - one)).toString(16);
  return "#" + parts.map((one) => lighter(one).padStart(2, "0")).join("");
}

const min = (a) => a.reduce((x, y) => Math.min(x, y), Infinity),
  max = (a) => a.reduce((x, y) => Math.max(x, y), -Infinity);

function drawTrack() {
  const edges = [course.right, course.left].map(([x, y]) => way(x, y, true)),
    road = new Path2D();
  for (const edge of edges) road.addPath(edge);
  fill(road, css("--road"), 1, "evenodd");
  for (const edge of edges) stroke(edge, css("--edge"), 1);
  stroke(way(...course.start), css("--ink"), 2);
  // An arrow beside the start line, whose first end is the right one.
  const [[x, x1], [y, y1]] = course.start;
  pen.save();
  pen.translate(...px(x1 + 0.16 * (x1 - x), y1 + 0.16 * (y1 - y)));
  pen.rotate(Math.atan2(x1 - x, y1 - y));
  stroke(new Path2D("M0 0H18M13 -4L18 0L13 4"), css("--ink"), 1.4);
  pen.restore();
  drawSectors();
}

function drawSectors() {
  const { right, left } = course,
    count = right[0].length;
  const across = (share, i) => [0, 1].map((c) => left[c][i] + share * (right[c][i] - left[c][i]));
  for (let k = 0; k < SECTORS; k++) {
    const centre = Math.round(((k + 0.5) / SECTORS) * count) % count,
      edge = Math.round((k / SECTORS) * count);
    write("S" + (k + 1), px(...across(1.22, centre)), 4, css("--muted"), 11);
    if (k)
      stroke(
        way([left[0][edge], right[0][edge]], [left[1][edge], right[1][edge]]),
        css("--muted"),
        1,
      );
  }
}

// A text at a place, and so much below it.
function write(text, [x, y], below, colour, size) {
  pen.fillStyle = colour;
  pen.font = `${size}px sans-serif`;
  pen.textAlign = "center";
  pen.fillText(text, x, y + below);
}

// Time lost on each metre [ms/m] on the grid, and a size of it that is rarely exceeded.
function lossOnEachMetre(run) {
  const loss = lost(run),
    step = length() / GRID;
  const rate = loss.map((one, g) =>
    one === null || g === 0 || loss[g - 1] === null ? 0 : (one - loss[g - 1]) / step,
  );
  return { rate, size: rate.map(Math.abs).sort((a, b) => a - b)[Math.floor(0.95 * GRID)] || 1 };
}

function drawLoss(run, { rate, size }) {
  const lap = lapOf(run),
    same = reference() === run,
    { x, y, s, t } = run.rows,
    L = length();
  const [gain, lose, calm] = ["--gain", "--loss", "--muted"].map(css);
  pen.lineCap = "round";
  for (let i = lap.first + 1; i <= lap.last; i++) {
    const at = course.length ? s[i] - lap.k * L : t[i],
      share = Math.max(-1, Math.min(1, (rate[Math.round((at / L) * GRID)] || 0) / size)),
      part = Math.round(100 * Math.abs(share));
    const mixed = `color-mix(in srgb, ${share > 0 ? lose : gain} ${part}%, ${calm})`;
    stroke(way([x[i - 1], x[i]], [y[i - 1], y[i]]), same ? paint(run) : mixed, 3.2);
  }
}

function drawPlan(run, row) {
  const plan = run.plans.findLast((one) => one[0] <= run.base + row);
  if (!plan || run.base + row - plan[0] > 40) return;
  const [, [xs, ys], tube] = plan;
  const side = (sign) => (x, i) => {
    const j = Math.min(Math.max(i, 1), xs.length - 1),
      dx = xs[j] - xs[j - 1],
      dy = ys[j] - ys[j - 1],
      w = (sign * (i ? tube[i - 1] || 0 : 0)) / (Math.hypot(dx, dy) || 1);
    return [x - w * dy, ys[i] + w * dx];
  };
  const ring = [...xs.map(side(1)), ...xs.map(side(-1)).reverse()];
  fill(way(...[0, 1].map((c) => ring.map((one) => one[c])), true), paint(run), 0.3);
  stroke(way(xs, ys), css("--ink"), 1.6);
}

function drawCar(run, at, main) {
  if (!at) return;
  const place = px(value(run, "x", at), value(run, "y", at)),
    [long, wide] = course.car || [0.12, 0.06],
    l = Math.max(long * scale, main ? 15 : 12) / 2,
    w = Math.max(wide * scale, main ? 8 : 6) / 2;
  const body = new Path2D(`M${l} 0L${l / 2} ${w}H${-l}V${-w}H${l / 2}Z`);
  pen.save();
  pen.translate(...place);
  pen.rotate(-value(run, "psi", at));
  fill(body, paint(run));
  stroke(body, css("--paper"), 1);
  pen.restore();
  write([...runs.keys()].indexOf(run.key) + 1, place, -w - 4, css("--ink"), 10);
}
