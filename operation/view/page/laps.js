"use strict";
// The page: it takes updates (bayesrace/operation/view/runs.py) and draws laps over the track.
// Laps are compared at the same place: each is resampled to one grid of progress s. The clock is the
// time since the lap's start, the same for all runs, as if their cars drove at once.

const GRID = 600,
  SECTORS = 6,
  SMOOTH = 9;
const DASHES = [[], [8, 3], [2, 3], [8, 3, 2, 3], [14, 4], [4, 4]];
const el = (id) => document.getElementById(id);
const css = (name) => getComputedStyle(el("view")).getPropertyValue(name).trim();
const runs = new Map(); // key -> run, in the order in which they were driven
let course = {},
  dashes = 0, // that are given to runs
  plots = [];
let choice = { lap: "", t: 0, active: "", ref: "", off: new Set(), follow: false, zoom: false };
let playing = 0,
  hover = null,
  dirty = { map: true, rest: true },
  drawnAt = 0;

/* --- what is told --- */

function take(updates) {
  for (const one of updates) {
    if (one.kind === "course") begin(one);
    else if (one.kind === "fault") fault = one.text;
    else if (one.kind === "gone") runs.delete(one.key);
    else takeRows(one);
  }
  if (!choice.lap) choice.lap = UPDATES ? "fastest" : "newest";
  redraw();
}

function begin(told) {
  course = told;
  runs.clear();
  dashes = 0;
  fault = laid = "";
  el("title").textContent = told.title;
  if (!EMBEDDED) document.title = told.title;
}

function takeRows({ key, base, from, rows, plans, laps, ...news }) {
  let run = runs.get(key);
  if (!run || from > run.base + run.rows.t.length) {
    // rows that are not kept any more
    const { laps: known = [], dash = DASHES[dashes++ % DASHES.length] } = run || {};
    run = { key, base: from, rows: {}, plans: [], laps: known, dash };
    for (const name of course.columns) run.rows[name] = [];
    runs.set(key, run);
  }
  for (const name of course.columns) for (const value of rows[name]) run.rows[name].push(value);
  run.plans.push(...plans);
  for (const [number, begin, time] of laps) run.laps.push({ number, begin, time });
  Object.assign(run, news, { cache: new Map(), heard: performance.now() });
  if (base > run.base) forget(run, base - run.base);
}

function forget(run, count) {
  for (const values of Object.values(run.rows)) values.splice(0, count);
  run.base += count;
  run.plans = run.plans.filter((plan) => plan[0] >= run.base);
}

/* --- laps --- */

// When a lap began, and its time if it is over; null if the run has none of that number.
function lapTimes(run, number) {
  const whole = run.laps.find((lap) => lap.number === number);
  if (whole) return whole;
  if (run.begun && run.begun[0] === number) return { begin: run.begun[1], time: null };
  return number === 0 && !course.length ? { begin: run.rows.t[0] ?? 0, time: null } : null;
}

const length = () =>
  course.length || Math.max(1, ...[...runs.values()].map((run) => run.rows.t.at(-1) || 1));

function lapNumber(run) {
  const last = run.laps.at(-1),
    begun = run.begun ? run.begun[0] : 0;
  if (choice.lap === "newest") return run.text && last ? last.number : begun;
  if (choice.lap === "fastest") {
    const kept = run.laps.filter((lap) => isKept(run, lap.begin));
    return kept.length ? kept.reduce((a, b) => (b.time < a.time ? b : a)).number : begun;
  }
  return Number(choice.lap);
}

// Whether the rows of a lap that began then have not been forgotten.
const isKept = (run, begin) => begin >= run.rows.t[0] - 0.5;

// The lap of a run that is shown, on the grid; null if it has none. `end`: its time, so far.
function lapOf(run) {
  const k = lapNumber(run);
  if (!run.cache.has(k)) run.cache.set(k, resampled(run, k));
  return run.cache.get(k);
}

function resampled(run, k) {
  const times = lapTimes(run, k);
  if (!times || !isKept(run, times.begin)) return null;
  const { t, s } = run.rows,
    L = length(),
    begin = times.begin,
    where = course.length ? s : t;
  let i = 0;
  while (i < t.length && (t[i] < begin - 0.05 || where[i] === null)) i++;
  if (i >= t.length) return null;
  const first = i,
    at = [],
    index = []; // places that only grow, and the rows they come from
  for (let far = -Infinity; i < t.length && where[i] !== null; i++) {
    const here = where[i] - k * (course.length || 0);
    if (here > L + 0.5 || (far > -Infinity && here - far > 0.1 * L)) break; // a leap leaves out track
    if (here > far) {
      at.push(here);
      index.push(i);
      far = here;
    }
  }
  const done = times.time !== null,
    last = done || run.text ? index.at(-1) : t.length - 1;
  const lap = { k, begin, first, last, end: done ? times.time : t[last] - begin, done, grid: {} };
  for (const name of course.columns) lap.grid[name] = new Array(GRID + 1).fill(null);
  for (let g = 0, j = 0; g <= GRID; g++) {
    const want = (g / GRID) * L;
    while (j + 1 < at.length && at[j + 1] < want) j++;
    if (j + 1 >= at.length || want > at[j + 1] || want < at[0] - 0.3) continue;
    const share = Math.min(1, Math.max(0, (want - at[j]) / (at[j + 1] - at[j])));
    for (const name of course.columns) {
      const a = run.rows[name][index[j]],
        b = run.rows[name][index[j + 1]];
      if (a !== null && b !== null) lap.grid[name][g] = name === "level" ? b : a + share * (b - a);
    }
  }
  lap.time = lap.grid.t.map((one) => (one === null ? null : one - begin));
  return lap;
}

// The newest of runs: of those that are still driven, if any is.
const newestOf = (some) =>
  some.findLast((run) => !run.text && performance.now() - run.heard < 3000) || some.at(-1);

const shown = () => [...runs.values()].filter((run) => !choice.off.has(run.key) && lapOf(run));

function reference() {
  const some = shown().filter((run) => lapOf(run).done),
    chosen = some.find((run) => run.key === choice.ref);
  return chosen || some.sort((a, b) => lapOf(a).end - lapOf(b).end)[0] || null;
}

function active() {
  if (runs.has(choice.active)) return runs.get(choice.active);
  const some = shown(),
    ref = reference();
  const newest = choice.follow && newestOf(some);
  return newest || some.find((run) => run !== ref && lapOf(run).done) || ref || some[0];
}

// Time behind the reference at each place [ms], smoothed: feet on a bent centreline jump by millimetres.
function lost(run) {
  const ref = reference(),
    lap = lapOf(run);
  if (!ref || !lap) return new Array(GRID + 1).fill(null);
  const other = lapOf(ref).time;
  const raw = lap.time.map((one, g) =>
    one === null || other[g] === null ? null : 1e3 * (one - other[g]),
  );
  return raw.map((one, g) => {
    if (one === null) return null;
    const near = raw.slice(Math.max(0, g - SMOOTH), g + SMOOTH + 1).filter((v) => v !== null);
    return near.reduce((a, b) => a + b, 0) / near.length;
  });
}

// The row of a run at the clock, with the share of the way to the next one.
function rowAt(run) {
  const lap = lapOf(run),
    { t } = run.rows;
  if (!lap) return null;
  if (hover !== null) {
    const time = lap.time[hover];
    return time === null ? null : rowOf(t, lap, lap.begin + time);
  }
  const now = choice.follow && !run.text; // cars that drive at once are where they are
  return rowOf(t, lap, lap.begin + (now ? lap.end : Math.min(choice.t, lap.end)));
}

function rowOf(t, lap, time) {
  let low = lap.first,
    high = Math.max(lap.last, lap.first + 1);
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (t[middle] <= time) low = middle;
    else high = middle;
  }
  if (high >= t.length) return { row: low, share: 0 };
  return { row: low, share: Math.min(1, Math.max(0, (time - t[low]) / (t[high] - t[low] || 1))) };
}

function value(run, name, at) {
  const a = run.rows[name][at.row],
    b = run.rows[name][at.row + 1];
  return a == null || b == null ? (a ?? null) : a + at.share * (b - a);
}
