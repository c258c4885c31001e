"use strict";
/* --- clock --- */

const lapEnd = () => Math.max(0.001, ...shown().map((run) => lapOf(run).end));

function setTime(t) {
  choice.t = Math.max(0, Math.min(t, lapEnd()));
  choice.follow = false;
  dirty.map = true;
}

function tick(now) {
  requestAnimationFrame(tick); // first, so that an error does not stop the page for good
  const past = Math.min(0.1, (now - (tick.last || now)) / 1e3);
  tick.last = now;
  if (playing) {
    choice.t += past * Number(el("rate").value);
    if (choice.t > lapEnd()) choice.t = 0;
    dirty.map = true;
  }
  const newest = newestOf([...runs.values()]);
  if (choice.follow && newest && lapOf(newest)) choice.t = lapOf(newest).end;
  if (dirty.rest && now - drawnAt > 250) {
    drawnAt = now;
    drawTables();
    drawCharts();
    dirty.rest = false;
    dirty.map = true;
  }
  if (dirty.map) {
    drawMap();
    drawCursor();
    dirty.map = false;
    const end = lapEnd();
    el("time").max = end;
    el("time").value = choice.t;
    say(el("now"), number(choice.t, 3) + " s");
    if (hover === null) moveCursor();
  }
}

// All charts show where the active car is at the clock.
function moveCursor() {
  const run = active(),
    at = run && rowAt(run);
  if (!at || !plots.length) return;
  const s = course.length
    ? Math.max(0, value(run, "s", at) - lapOf(run).k * course.length)
    : value(run, "t", at);
  for (const { chart } of plots) chart.setCursor({ left: chart.valToPos(s, "x"), top: 10 }, false);
}

function play() {
  playing = 1 - playing;
  choice.follow = false;
  el("play").textContent = playing ? "⏸" : "▶";
}

/* --- what the user does --- */

const redraw = () => (dirty = { map: true, rest: true });
function changed() {
  redraw();
  drawnAt = 0;
  remember();
}
function remember() {
  const order = [...runs.keys()],
    words = {
      lap: choice.lap,
      t: choice.follow ? "" : choice.t.toFixed(3),
      run: order.indexOf(choice.active) + 1 || "",
      ref: order.indexOf(choice.ref) + 1 || "",
      off: [...choice.off].map((key) => order.indexOf(key) + 1).join("."),
    };
  const hash = new URLSearchParams(Object.entries(words).filter((one) => one[1] !== ""));
  history.replaceState(null, "", "#" + hash);
}
function recall() {
  const given = new URLSearchParams(location.hash.slice(1)),
    order = [...runs.keys()];
  const key = (name) => order[given.get(name) - 1] || "";
  if (given.get("lap")) choice.lap = given.get("lap");
  choice.active = key("run");
  choice.ref = key("ref");
  const off = (given.get("off") || "").split(".");
  choice.off = new Set(off.flatMap((one) => order[one - 1] ?? []));
  if (given.has("t")) choice.t = Number(given.get("t")) || 0;
  choice.follow = !UPDATES && !given.has("t");
}
function toggle(key) {
  choice.off.has(key) ? choice.off.delete(key) : choice.off.add(key);
  changed();
}
function theme(dark) {
  el("view").dataset.theme = dark ? "dark" : "light";
  redraw();
}
function live() {
  if (playing) play();
  choice.lap = "newest";
  choice.follow = true;
  changed();
}
const dark = () => el("view").dataset.theme === "dark";

el("play").onclick = play;
el("theme").onclick = () => theme(!dark());
el("help").onclick = () => el("keys").showModal();
el("zoom").onclick = () => {
  choice.zoom = !choice.zoom;
  el("zoom").ariaPressed = choice.zoom;
  dirty.map = true;
};
el("time").oninput = (event) => setTime(Number(event.target.value));
el("time").onchange = remember;
el("lap").onchange = (event) => {
  choice.lap = event.target.value;
  choice.follow = choice.lap === "newest" && !UPDATES;
  changed();
};
el("live").onclick = live;
// A page that is a part of another one has the keys while it has the focus.
(EMBEDDED ? el("view") : document).addEventListener("keydown", (event) => {
  const own = ["SELECT", "INPUT", "BUTTON", "SUMMARY", "DIALOG"].includes(event.target.tagName);
  if (own || el("keys").open || event.ctrlKey || event.metaKey || event.altKey) return;
  const step = event.shiftKey ? 1 : 0.1,
    keys = [...runs.keys()],
    laps = [...el("lap").options].map((one) => one.value);
  const goBy = (seconds) => {
    setTime(choice.t + seconds);
    remember();
  };
  const lap = (by) => {
    choice.lap = laps[Math.max(0, Math.min(laps.length - 1, laps.indexOf(choice.lap) + by))];
    changed();
  };
  const act =
    {
      " ": play,
      ArrowLeft: () => goBy(-step),
      ArrowRight: () => goBy(step),
      ArrowUp: () => lap(-1),
      ArrowDown: () => lap(1),
      f: el("zoom").onclick,
      l: UPDATES ? null : live,
      t: el("theme").onclick,
      "?": el("help").onclick,
      n: () => {
        choice.active = keys[(keys.indexOf(active()?.key) + 1) % keys.length];
        changed();
      },
      0: () => {
        laid = "";
        changed();
      },
    }[event.key] ||
    (/^[1-9]$/.test(event.key) && keys[event.key - 1] ? () => toggle(keys[event.key - 1]) : null);
  if (act) {
    event.preventDefault();
    act();
  }
});
addEventListener("resize", () => {
  for (const { chart, box } of plots) chart.setSize({ width: box.clientWidth - 20, height: 190 });
  dirty.map = true;
});
addEventListener("beforeprint", () => {
  const screen = dark();
  drawIn(false);
  addEventListener("afterprint", () => drawIn(screen), { once: true });
});
function drawIn(dark) {
  theme(dark);
  drawCharts();
  drawMap();
}
addEventListener("hashchange", () => {
  recall();
  redraw();
});
addEventListener("error", (event) => say(el("state"), `this page has a fault: ${event.message}`));

/* --- start --- */

let fault = "";
const counted = () => `${runs.size} run${runs.size === 1 ? "" : "s"}${fault ? "; " + fault : ""}`;

let recalled = false;
function connect(wait = 250) {
  const url = new URL("updates" + location.search, location.href);
  url.protocol = url.protocol.replace("http", "ws");
  const link = new WebSocket(url);
  let begun = false,
    silent;
  const lost = () => {
    clearTimeout(silent);
    link.onopen = link.onmessage = link.onclose = null;
    link.close();
    say(el("state"), "connection lost; it is tried again");
    setTimeout(() => connect(Math.min(5000, 2 * wait)), begun ? 250 : wait);
  };
  // Something is said every 3 s: a connection can be dead without anyone having closed it.
  const heard = () => {
    clearTimeout(silent);
    silent = setTimeout(lost, 15000);
  };
  heard();
  link.onclose = lost;
  link.onopen = () => say(el("state"), "connected; nothing is driven yet");
  link.onmessage = (event) => {
    heard();
    const updates = JSON.parse(event.data);
    if (!updates.length) return;
    begun = true;
    take(updates);
    if (!recalled) recall();
    recalled = true;
    say(el("state"), counted());
  };
}

theme(!EMBEDDED && matchMedia("(prefers-color-scheme: dark)").matches); // a report is light
if (UPDATES) {
  take(UPDATES);
  recall();
  say(el("state"), counted());
} else connect();
requestAnimationFrame(tick);
