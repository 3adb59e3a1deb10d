// State of the points, changes of it, and saving.
"use strict";

const about = JSON.parse(document.getElementById("about").textContent);
const byId = (id) => document.getElementById(id);
const canvas = byId("canvas");
const COLOURS = { set: [1, 0.85, 0.1], next: [0.2, 1, 0.3], suggested: [0.3, 0.65, 1] };

const state = {
  names: about.names, points: { ...about.points }, suggestions: {}, selected: null, history: [],
  bounds: null, box: null, seen: "", dirty: false, saved: false,
};
const view = { azimuth: 0, elevation: 0, distance: 1, target: [0, 0, 0], size: 1 };
let mesh, painter, asked = 0, scrolled = null;

function say(text, kind = "") {
  byId("status").textContent = text;
  byId("status").className = kind;
}

function draw() {
  const places = (of, wanted) => Object.entries(of).filter(([name]) => (name === state.selected) === wanted).map(([, p]) => p);
  const shown = byId("suggest").checked ? state.suggestions : {};
  painter.draw(view, state.box, byId("coloured").checked, [
    { points: places(shown, false), colour: COLOURS.suggested, size: 11 },
    { points: places(shown, true), colour: COLOURS.suggested, size: 17 },
    { points: places(state.points, false), colour: COLOURS.set, size: 11 },
    { points: places(state.points, true), colour: COLOURS.next, size: 15 },
  ]);
}

function front() {
  const { low, high } = state.bounds;
  view.size = Math.hypot(...sub(high, low));
  Object.assign(view, { azimuth: 0, elevation: 0, target: add(low, high).map((x) => x / 2) });
  view.distance = (0.5 * Math.max(high[0] - low[0], high[1] - low[1])) / TANGENT + (high[2] - low[2]) / 2;
}

async function post(path, value) {
  const answer = await fetch(path, {
    method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(value),
  });
  if (!answer.ok) throw new Error(`skindb refused the request: ${answer.statusText}`);
  return answer.json();
}

async function suggest() {
  const number = ++asked, reply = await post("suggest", { points: state.points });
  if (number !== asked) return;  // a later request is pending
  state.suggestions = reply.points || {};
  show();
}

function show() {
  const count = Object.keys(state.names).filter((name) => name in state.points).length;
  byId("count").textContent = `${count} of ${Object.keys(state.names).length} points are set.`;
  byId("undo").disabled = !state.history.length;
  byId("all").disabled = !Object.keys(state.suggestions).length;
  showList(byId("points"), { ...state, suggestions: byId("suggest").checked ? state.suggestions : {} }, actions);
  const next = document.querySelector("li.next");
  if (next && state.selected !== scrolled) next.scrollIntoView({ block: "center" });
  scrolled = state.selected;
  draw();
}

function remember() {
  state.history.push({ points: { ...state.points }, selected: state.selected });
}

function firstOpen() {
  return Object.keys(state.names).find((name) => !(name in state.points)) || null;
}

function changed() {
  state.dirty = true;
  say(state.saved ? "The changes since the last save are not saved yet." : "");
  byId("questions").replaceChildren();
  for (const name of Object.keys(state.points)) delete state.suggestions[name];
  show();
  return suggest().catch((error) => say(error.message, "fault"));
}

function set(name, place) {
  remember();
  state.points[name] = place;
  state.selected = firstOpen();
  return changed();
}

const hit = (x, y) => { const { origin, ray } = rayThrough(canvas, view, x, y); return pick(mesh, origin, ray); };

const actions = {
  draw, front,
  select: (name) => { state.selected = name; show(); },
  accept: (name) => set(name, state.suggestions[name]),
  remove: (name) => { remember(); delete state.points[name]; state.selected = name; changed(); },
  click: (x, y) => {
    const place = hit(x, y);
    if (place === null) return;
    if (state.selected === null) say("All points are set. Select one in the list to set it again.");
    else set(state.selected, place);
  },
  // the point must also be near the surface under the pointer, so that points behind the surface are not grabbed
  grab: (x, y) => {
    const place = Object.keys(state.points).length ? hit(x, y) : null;
    if (place === null) return null;
    const pixel = (2 * TANGENT * view.distance) / canvas.getBoundingClientRect().height;
    const far = (p) => Math.hypot(...sub(project(canvas, view, p), [x, y]));
    const near = Object.entries(state.points).filter(([, p]) => far(p) < GRAB && Math.hypot(...sub(p, place)) < 4 * GRAB * pixel);
    near.sort((a, b) => far(a[1]) - far(b[1]));
    return near.length ? near[0][0] : null;
  },
  drag: (name, x, y) => {
    const place = hit(x, y);
    if (place === null) return;
    if (!state.dragging) remember();
    state.dragging = true;
    state.points[name] = place;
  },
  drop: () => { state.dragging = false; changed(); },
};

function undo() {
  if (!state.history.length) return;
  Object.assign(state, state.history.pop());
  changed();
}

function acceptAll() {
  remember();
  Object.assign(state.points, state.suggestions);
  state.selected = firstOpen();
  changed();
}

// confirmations contain the text of the questions, so that only questions that were asked are confirmed
async function save(confirmed = []) {
  byId("questions").replaceChildren();
  const body = { points: state.points, crop: chosenBox(state), seen: state.seen, confirmed };
  const reply = await post("save", body).catch((error) => ({ faults: [error.message] }));
  if (reply.faults) say(`Nothing was saved. ${reply.faults.join("\n")}`, "fault");
  else if (reply.questions) {
    say(state.saved ? "The changes since the last save are not saved yet." : "Nothing is saved yet.");
    const yes = element("button", { type: "button", textContent: "Save anyway", onclick: () => save(reply.questions) });
    const no = element("button", { type: "button", textContent: "Cancel", onclick: () => byId("questions").replaceChildren() });
    byId("questions").append(...reply.questions.map((text) => element("p", { textContent: text })), yes, " ", no);
    yes.focus();
  } else {
    state.seen = reply.seen;
    [state.dirty, state.saved] = [false, true];
    say(reply.saved, "saved");
  }
}

async function start() {
  mesh = await readMesh(about);
  state.bounds = bounds(mesh.position);
  const box = about.crop || { low: state.bounds.low.map(Math.floor), high: state.bounds.high.map(Math.ceil) };
  state.box = { low: [...box.low], high: [...box.high] };
  state.selected = firstOpen();
  front();
  byId("coloured").checked = about.colours;
  byId("coloured").parentElement.hidden = !about.colours;
  painter = new ScanPainter(canvas, mesh);
  cropSliders(byId("crop"), state, () => { state.dirty = true; draw(); });
  listen(canvas, view, actions);
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => { painter.prepare(); draw(); });
  new ResizeObserver(draw).observe(canvas);
  byId("suggest").onchange = byId("coloured").onchange = show;
  byId("undo").onclick = undo;
  byId("all").onclick = acceptAll;
  byId("save").onclick = () => save();
  document.addEventListener("keydown", (event) => {
    if ((event.ctrlKey || event.metaKey) && event.key === "z") { event.preventDefault(); undo(); }
  });
  window.addEventListener("beforeunload", (event) => { if (state.dirty) event.preventDefault(); });
  show();
  await suggest();
}

const ready = start().catch((error) => { say(error.message, "fault"); throw error; });
window.skindb = { ready, state, view, draw, project: (point) => project(canvas, view, point) };
