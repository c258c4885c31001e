"use strict";
/* --- tables --- */

const number = (one, digits) =>
  one == null
    ? "–"
    : one
        .toFixed(digits)
        .replace(/^-(?=[0.]*$)/, "")
        .replace("-", "−");

// Writes a text; the same again changes nothing, so that nobody who selects or hears it is disturbed.
function say(where, text) {
  if (where.textContent !== text) where.textContent = text;
}

// An element with properties and children, which are texts or elements.
function made(tag, properties = {}, ...children) {
  const one = Object.assign(document.createElement(tag), properties);
  one.append(...children);
  return one;
}

// A piece of a run's line, as it is in charts.
function mark(run) {
  const box = made("template");
  box.innerHTML = `<svg class="mark" width="26" height="8" aria-hidden="true">
    <path d="M0 4H26" stroke-width="3" stroke-dasharray="${run.dash.join(" ")}"/></svg>`;
  const [mark] = box.content.children;
  mark.style.stroke = paint(run);
  return mark;
}

// A row of the table of runs, made once, so that a click or the focus is not lost while it changes.
function rowOfRun(run, index) {
  const button = (className, title, onclick, child) =>
    made("button", { className, title, onclick, ariaLabel: `${run.label}: ${title}` }, child);
  const choose = (name) => () => {
    choice[name] = choice[name] === run.key ? "" : run.key;
    changed();
  };
  const row = made("tr");
  row.toggle = button("toggle", "show or hide", () => toggle(run.key), mark(run));
  row.active = button("name", "show on the map where it loses time", choose("active"), run.label);
  row.ref = button("", "compare all with this lap", choose("ref"), "◎");
  row.shows = [made("td"), made("td"), made("td", { className: "laps" })];
  const [time, behind, laps] = row.shows;
  row.append(made("td", {}, `${index + 1} `, row.toggle, row.active), time, behind);
  row.append(made("td", {}, row.ref), laps);
  return row;
}

function drawRuns(ref, main) {
  const all = [...runs.values()],
    table = el("runs"),
    look = el("view").dataset.theme;
  const known = JSON.stringify([look, ...all.map((run) => [run.key, run.label])]);
  if (table.known !== known) {
    table.known = known;
    table.rowsOf = new Map(all.map((run, i) => [run.key, rowOfRun(run, i)]));
    const heads = ["", "lap [s]", "to reference", "", "laps [s]"].map((text, i) =>
      made("th", { className: i === 4 ? "laps" : "" }, text),
    );
    table.replaceChildren(made("tr", {}, ...heads), ...table.rowsOf.values());
  }
  for (const run of all) {
    const row = table.rowsOf.get(run.key),
      lap = lapOf(run),
      hidden = choice.off.has(run.key);
    const gap = lap && ref && lap.done ? lap.end - lapOf(ref).end : null;
    row.className = (run === main ? "active " : "") + (hidden ? "off" : "");
    row.toggle.ariaPressed = !hidden;
    row.active.ariaPressed = run === main;
    row.ref.ariaPressed = run === ref;
    row.title = run.text;
    const open = lap && !lap.done ? (run.text ? "not finished" : number(lap.end, 3) + " …") : "";
    const time = open || number(lap?.end, 3);
    const behind =
      run === ref ? "reference" : gap === null ? "–" : (gap > 0 ? "+" : "") + number(gap, 3);
    const newest = run.laps.slice(-3).map((one) => number(one.time, 3)),
      laps = newest.join(", ") || "none";
    [time, behind, laps].forEach((text, i) => say(row.shows[i], text));
  }
}

function drawSectorTable(ref) {
  const width = GRID / SECTORS,
    names = Array.from({ length: SECTORS }, (_, k) => `S${k + 1}`);
  el("compared").textContent = ref
    ? `Time lost to ${ref.label}, lap ${lapOf(ref).k + 1}, by sector [ms]`
    : "";
  const others = ref ? shown().filter((run) => run !== ref) : [];
  const rows = others.map((run) => {
    const all = lost(run),
      ends = Array.from({ length: SECTORS + 1 }, (_, k) => all[k * width]);
    if (ends[0] !== null) ends[0] = 0;
    const cells = ends.slice(1).map((one, k) => {
      const ms = one === null || ends[k] === null ? null : one - ends[k],
        cell = made("td", {}, number(ms, 0)),
        colour = ms > 0 ? "--loss" : "--gain",
        share = Math.min(60, Math.round(Math.abs(ms ?? 0)));
      cell.style.background = `color-mix(in srgb, var(${colour}) ${share}%, transparent)`;
      return cell;
    });
    const lap = lapOf(run),
      whole = lap.done ? 1e3 * (lap.end - lapOf(ref).end) : null;
    cells.push(made("td", {}, number(whole, 0)));
    return made("tr", {}, made("td", {}, mark(run), " " + run.label), ...cells);
  });
  const heads = ["", ...names, "lap"].map((text) => made("th", {}, text));
  el("sectors").replaceChildren(...(rows.length ? [made("tr", {}, ...heads), ...rows] : []));
}

function drawTables() {
  const ref = reference();
  drawRuns(ref, active());
  drawSectorTable(ref);
  const begun = [...runs.values()].flatMap((run) => [
    ...run.laps.map((lap) => lap.number),
    ...(run.begun && !run.text ? [run.begun[0]] : []),
  ]);
  const laps = [...new Set(begun)].sort((a, b) => a - b).slice(-50),
    options = ["newest", "fastest", ...laps.map(String)];
  if (el("lap").known !== options.join()) {
    el("lap").known = options.join();
    const named = (one) => new Option(/\d/.test(one) ? Number(one) + 1 : one, one);
    el("lap").replaceChildren(...options.map(named));
  }
  el("lap").value = choice.lap;
  el("live").hidden = Boolean(UPDATES);
  el("live").ariaPressed = choice.follow;
}

const SAID = [
  ["v", "speed [m/s]", 2],
  ["d", "drive command", 2],
  ["delta", "steering [rad]", 2],
  ["error_mm", "off plan [mm]", 2],
  ["solve_us", "step [µs]", 0],
  ["answer_ms", "state to actuation [ms]", 2],
];
function drawCursor() {
  const run = active(),
    at = run && rowAt(run);
  if (!at) return say(el("cursor"), "");
  const lap = lapOf(run),
    s = value(run, "s", at);
  const place = s === null ? "" : `s = ${number(Math.max(0, s - lap.k * length()), 2)} m, `;
  const said = SAID.filter(([name]) => value(run, name, at) !== null).map(
    ([name, words, digits]) => `${words} ${number(value(run, name, at), digits)}`,
  );
  const when = number(value(run, "t", at) - lap.begin, 3);
  say(el("cursor"), `Now: ${run.label} at ${place}${when} s: ${said.join(", ")}`);
}
