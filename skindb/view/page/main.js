// The page: controls, pointer, keys, and scheduling of drawing.
"use strict";

const $ = (id) => document.getElementById(id);
const COMPONENTS = {
  picture: "",
  normals: "Red, green and blue are x (to the subject's left), y (up) and z (out of the face), from -1 to 1.",
  translucency: "Diffusion length 1 / sigma_tr of red, green and blue; white is 3 mm.",
  "status of the fit": "Green: measured; yellow: doubtful; red: not fitted, filled in from the surroundings.",
  "error of the albedo": "Relative standard error including that of the model, from 0 (blue) to 30 % (yellow).",
  albedo: "Diffuse reflectance, without lighting.",
};
const BACKGROUNDS = { studio: null, black: [0, 0, 0], grey: [0.47, 0.47, 0.47], white: [1, 1, 1] };  // studio is that of the style
const PRESETS = [[-18, 38, 0.85], [150, 25, 1.2], [-60, 10, 0.5], [-20, 70, 0.5]];  // azimuth, elevation and power of a key, a rim and other lights
const REST_MS = 300;  // a movement has ended after this time without another change
const SLOW_MS = 66, FAST_MS = 25;  // of a frame, beyond which fewer or more pixels are drawn while something moves
const TURN = { angle: 30, seconds: 16 };
const state = {
  azimuth: TURN.angle, elevation: 4, distance: 700, tangent: 0.2, exposure: 1, softness: 1.5, divider: 1, component: 0, toned: true,
  withDiffuse: true, withSurface: true, glow: true, background: BACKGROUNDS.studio, lights: [], around: { on: true, turn: 0, power: 0.35 },
};
let painter = null, face = null, amounts = [], active = 0, pending = false, moving = null, turning = null;
const speed = { fraction: 1, most: 1 };  // of the pixels along a side, while something moves

function say(text) { $("status").textContent = text; }

function redraw() {
  if (pending || !painter) return;
  pending = true;
  requestAnimationFrame(() => {
    const isMoving = moving !== null, begin = performance.now();
    pending = false;
    resize();
    if (painter.draw(state, isMoving) < 1) redraw();
    if (isMoving) {
      painter.finish();
      adapt(performance.now() - begin);
      waitForRest();  // a slow frame is no rest
    }
    placePhotograph();
  });
}

// Draws fewer pixels while something moves if frames take too long, and at once without a graphics card.
function adapt(took) {
  const factor = took > SLOW_MS ? 0.8 : took < FAST_MS ? 1.1 : 1;
  speed.fraction = Math.min(Math.max(factor * speed.fraction, 0.25), speed.most);
}

function waitForRest() {
  clearTimeout(moving);
  moving = setTimeout(() => { moving = null; redraw(); }, REST_MS);
}

// for drawing while something moves
function redrawMoving() {
  waitForRest();
  redraw();
}

function resize() {
  const canvas = $("canvas"), ratio = Math.min(window.devicePixelRatio || 1, 2) * (moving === null ? 1 : speed.fraction);
  const width = Math.max(Math.round(canvas.clientWidth * ratio), 1), height = Math.max(Math.round(canvas.clientHeight * ratio), 1);
  if (canvas.width === width && canvas.height === height) return;
  Object.assign(canvas, { width, height });
  painter.drawn = "";
}

// Turns the face to the other side and back, until something is touched.
function turnSlowly(start) {
  turning = requestAnimationFrame((now) => {
    const part = (now - start) / (1000 * TURN.seconds);
    state.azimuth = TURN.angle * Math.cos(2 * Math.PI * Math.min(part, 1));
    redrawMoving();
    if (part < 1) turnSlowly(start);
    else turning = null;
  });
}

function stopTurning() {
  if (turning !== null) cancelAnimationFrame(turning);
  turning = null;
}

function stop() {
  stopTurning();
  clearTimeout(moving);
  moving = null;
  resize();
}

function slider(parent, label, { min, max, step, value, unit = "" }, change) {
  const row = document.createElement("label"), input = document.createElement("input"), shown = document.createElement("output");
  row.append(label, input, shown);
  Object.assign(input, { type: "range", min, max, step, value });
  input.setAttribute("aria-label", label);
  const showValue = () => { shown.textContent = `${Number(input.value).toFixed(step < 1 ? 2 : 0)}${unit}`; };
  input.addEventListener("input", () => { showValue(); change(Number(input.value)); redrawMoving(); });
  showValue();
  parent.append(row);
  return input;
}

function newLight() {
  const [azimuth, elevation, power] = PRESETS[state.lights.length % PRESETS.length];
  return { azimuth, elevation, distance: face.lightDistance, intensity: face.lightIntensity, power };
}

function showLights() {
  const list = $("lights");
  list.replaceChildren();
  state.lights.forEach((light, i) => {
    const group = document.createElement("fieldset"), legend = document.createElement("legend");
    legend.textContent = `Light ${i + 1}`;
    group.append(legend);
    light.inputs = {
      azimuth: slider(group, "azimuth", { min: -180, max: 180, step: 1, value: light.azimuth, unit: "°" }, (x) => { light.azimuth = x; }),
      elevation: slider(group, "elevation", { min: -89, max: 89, step: 1, value: light.elevation, unit: "°" }, (x) => { light.elevation = x; }),
    };
    slider(group, "power", { min: 0, max: 3, step: 0.05, value: light.power }, (x) => { light.power = x; });
    group.addEventListener("focusin", () => { active = i; });
    list.append(group);
  });
  $("fewer").disabled = state.lights.length < (state.around.on ? 1 : 2);
  $("more").disabled = state.lights.length >= MAX_LIGHTS;
}

// the line is hidden where both sides are the same
function showDivider() {
  const cut = $("cut"), at = Number($(photograph ? "wipe" : "divider").value), differ = photograph ? !$("gap").checked : amounts.some(Boolean);
  cut.hidden = !differ || at <= 0 || at >= 1;
  cut.style.left = `${100 * at}%`;
  [cut.dataset.left, cut.dataset.right] = photograph ? ["photograph", "model"] : ["before", "after"];
}

function applyTraits() {
  if (!face.traits.length) return;
  painter.update(editedValues(face, amounts), amounts.some(Boolean));
  showDivider();
}

// what the interpolation of an edit changes, and its error
function traitNote({ amount, errors }) {
  const names = { position: ["shape", (x) => `${x.toFixed(2)} mm`], albedo: ["albedo", percent], diffusion: ["diffusion length", percent] };
  const stated = Object.entries(names).filter(([name]) => name in errors).map(([name, [label, text]]) => `${label} ${text(errors[name])}`);
  if (!stated.length) return "Gloss is interpolated linearly.";
  return `Interpolated between 0 and ${amount}; median errors at ${amount / 2}: ${stated.join(", ")}.`;
}

function percent(x) { return `${(100 * x).toFixed(1)} %`; }

function showTraits() {
  const box = $("traits");
  box.replaceChildren();
  amounts = face.traits.map(() => 0);
  $("edit").hidden = !face.traits.length;
  face.traits.forEach((trait, i) => {
    const full = trait.amount, range = { min: trait.least, max: Math.max(full, 0), step: Math.abs(full) / 20, value: 0 };
    slider(box, trait.name, range, (x) => { amounts[i] = x / full; applyTraits(); });
    const note = document.createElement("p");
    note.className = "note";
    note.textContent = traitNote(trait);
    box.append(note);
  });
  state.divider = face.traits.length ? 0.5 : 1;
  $("divider").value = state.divider;
  showDivider();
}

// the meaning of the colours of a component
function showLegend() {
  const name = Object.keys(COMPONENTS)[state.component];
  $("legend").textContent = COMPONENTS[name] + (name === "translucency" ? translucencyNote() : "");
}

// says if a map has one colour
function translucencyNote() {
  if (!face.translucent) return " The model of this face has no translucency.";
  const ranges = [0, 1, 2].map((c) => {
    const values = face.diffusion.filter((_, i) => i % 3 === c);
    return [values.reduce((a, b) => Math.min(a, b)), values.reduce((a, b) => Math.max(a, b))];
  });
  if (ranges.some(([least, most]) => most - least > 0.01 * most)) return "";
  return ` One value was measured for the whole face: ${ranges.map(([, most]) => most.toFixed(2)).join(", ")} mm.`;
}

function showAbout() {
  const rows = Object.entries(face.attributes).map(([name, value]) => {
    const row = document.createElement("tr"), head = document.createElement("th"), cell = document.createElement("td");
    head.textContent = name;
    cell.textContent = value;
    row.append(head, cell);
    return row;
  });
  $("about").replaceChildren(...rows);
}

function load(record) {
  return readFace(record).then((found) => {
    face = found;
    painter.load(face);
    state.distance = face.radius * 6;
    state.tangent = 1.02 / 6;
    if (!state.lights.length) for (let i = 0; i < 2; i++) state.lights.push(newLight());
    showLights();
    showTraits();
    showPhotographs();
    showAbout();
    showLegend();
    $("translucent").disabled = !face.translucent || !painter.floats;
    if (!face.translucent) state.glow = $("translucent").checked = false;
    say(`${face.attributes.take}: ${(face.position.length / 3).toLocaleString()} surfels, ${(face.triangles.length / 3).toLocaleString()} triangles.`);
    redraw();
  });
}

async function requested(path) {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}

async function choose(name) {
  say(`Loading ${name} ...`);
  const embedded = $(`face-${name}`);
  await load(embedded ? JSON.parse(embedded.textContent) : await requested(`faces/${encodeURIComponent(name)}.json`));
}

function listen() {
  const canvas = $("canvas"), pointers = new Map();
  let gesture = null;  // of two fingers
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, event);
    gesture = pointers.size === 2 ? { kind: "", start: [...pointers.values()], ...fingers(pointers) } : null;
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    const dx = event.clientX - last.clientX, dy = event.clientY - last.clientY;
    pointers.set(event.pointerId, event);
    if (gesture) twoFingers(gesture, pointers);
    else if (event.shiftKey || event.buttons === 2) turnLight(0.4 * dx, -0.4 * dy);
    else turnView(-0.4 * dx, 0.4 * dy);
  });
  for (const kind of ["pointerup", "pointercancel"])
    canvas.addEventListener(kind, (event) => { pointers.delete(event.pointerId); gesture = null; });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(event.deltaY * 0.001)); }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const step = 5, turn = event.shiftKey ? turnLight : turnView;
    const keys = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
    if (keys[event.key]) turn(...keys[event.key]);
    else if (event.key === "+" || event.key === "=") zoom(1 / 1.1);
    else if (event.key === "-") zoom(1.1);
    else if (event.key === "0") { leavePhotograph(); state.azimuth = state.elevation = 0; redraw(); }
    else return;
    event.preventDefault();
  });
  canvas.addEventListener("webglcontextlost", (event) => { event.preventDefault(); say("The graphics context was lost and is being restored ..."); });
  canvas.addEventListener("webglcontextrestored", () => {
    painter.prepare();
    painter.load(face);
    applyTraits();
    say("The graphics context was restored.");
    redraw();
  });
  window.addEventListener("resize", redraw);
  for (const kind of ["pointerdown", "keydown", "wheel", "input"]) window.addEventListener(kind, stopTurning, { capture: true });
  $("cut").addEventListener("pointerdown", (event) => event.target.setPointerCapture(event.pointerId));
  $("cut").addEventListener("pointermove", (event) => {
    if (!event.buttons) return;
    const { left, width } = canvas.getBoundingClientRect();
    const input = $(photograph ? "wipe" : "divider");
    input.value = Math.min(Math.max((event.clientX - left) / width, 0.02), 0.98);
    input.dispatchEvent(new Event("input"));
  });
  $("sheet").addEventListener("click", (event) => {
    const open = document.body.classList.toggle("closed");
    event.currentTarget.setAttribute("aria-expanded", String(!open));
    redraw();
  });
  if (self !== top) $("sheet").click(); // a small frame in another page shows the picture
}

function fingers(pointers) {
  const [a, b] = [...pointers.values()];
  return { span: Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY), x: (a.clientX + b.clientX) / 2, y: (a.clientY + b.clientY) / 2 };
}

// Two fingers move the light if they move in the same direction, and zoom otherwise.
function twoFingers(gesture, pointers) {
  const now = fingers(pointers), [a, b] = [...pointers.values()].map((one, i) => [one.clientX - gesture.start[i].clientX, one.clientY - gesture.start[i].clientY]);
  if (gesture.kind === "zoom") zoom(gesture.span / Math.max(now.span, 1));
  else if (gesture.kind === "light") turnLight(0.4 * (now.x - gesture.x), -0.4 * (now.y - gesture.y));
  else if (Math.hypot(...a) + Math.hypot(...b) < 24) return;
  else gesture.kind = dot(a, b) > 0 ? "light" : "zoom";
  Object.assign(gesture, now);
}

function turnView(across, up) {
  leavePhotograph();
  state.azimuth = ((state.azimuth + across + 540) % 360) - 180;
  state.elevation = Math.min(Math.max(state.elevation + up, -85), 85);
  redrawMoving();
}

function turnLight(across, up) {
  leavePhotograph();
  const light = state.lights[active] || state.lights[0];
  if (!light) return;  // only the environment shines
  light.azimuth = ((light.azimuth + across + 540) % 360) - 180;
  light.elevation = Math.min(Math.max(light.elevation + up, -89), 89);
  for (const name of ["azimuth", "elevation"]) {
    light.inputs[name].value = light[name];
    light.inputs[name].dispatchEvent(new Event("input"));
  }
}

function zoom(factor) {
  leavePhotograph();
  state.distance = Math.min(Math.max(state.distance * factor, 1.6 * face.radius), 20 * face.radius);
  redrawMoving();
}

function controls() {
  Object.keys(COMPONENTS).forEach((name, i) => $("component").append(new Option(name, i)));
  $("component").addEventListener("change", (event) => {
    state.component = Number(event.target.value);
    showLegend();
    redraw();
  });
  for (const [id, key] of [["diffuse", "withDiffuse"], ["surface", "withSurface"], ["translucent", "glow"], ["toned", "toned"]])
    $(id).addEventListener("change", (event) => { state[key] = event.target.checked; redraw(); });
  Object.keys(BACKGROUNDS).forEach((name) => $("background").append(new Option(name)));
  $("background").addEventListener("change", (event) => { state.background = BACKGROUNDS[event.target.value]; redraw(); });
  $("around").addEventListener("change", (event) => {
    state.around.on = event.target.checked;
    if (!state.around.on && !state.lights.length) state.lights = [newLight()];
    showLights();
    redraw();
  });
  slider($("environment"), "rotation", { min: -180, max: 180, step: 5, value: 0, unit: "°" }, (x) => { state.around.turn = x; });
  slider($("environment"), "power of the environment", { min: 0, max: 3, step: 0.05, value: state.around.power }, (x) => { state.around.power = x; });
  slider($("camera"), "exposure", { min: 0.1, max: 4, step: 0.05, value: 1 }, (x) => { state.exposure = x; });
  slider($("camera"), "softness of shadows", { min: 0, max: 6, step: 0.5, value: 1.5 }, (x) => { state.softness = x; });
  $("divider").addEventListener("input", (event) => { state.divider = Number(event.target.value); showDivider(); redrawMoving(); });
  for (const id of ["wipe", "gap"]) $(id).addEventListener("input", () => { showDivider(); redraw(); });
  $("leave").addEventListener("click", leavePhotograph);
  $("more").addEventListener("click", () => { state.lights.push(newLight()); showLights(); redraw(); });
  $("fewer").addEventListener("click", () => { state.lights.pop(); active = 0; showLights(); redraw(); });
  $("shot").addEventListener("click", () => {
    stop();
    while (painter.draw(state) < 1);
    const link = document.createElement("a");
    link.download = `${face.attributes.take}.png`;
    link.href = $("canvas").toDataURL("image/png");
    link.click();
  });
}

function noPicture(reason) {
  document.body.classList.add("still");
  say(`${reason} Still pictures are shown instead.`);
}

async function start() {
  const picker = $("take"), names = JSON.parse($("takes").textContent);
  for (const one of names) picker.append(new Option(one.title, one.take));
  const wanted = () => choose(picker.value).catch((error) => say(`${picker.value} cannot be shown: ${error.message}`));
  const still = () => { const one = names[picker.selectedIndex]; if (one.still) $("still").src = one.still; };
  picker.addEventListener("change", () => { still(); if (painter) wanted(); });
  picker.parentElement.hidden = names.length < 2;
  still();
  if (new URLSearchParams(location.search).has("no-webgl")) return noPicture("WebGL is switched off.");
  try {
    painter = new Painter($("canvas"));
    speed.most = speed.fraction = painter.software ? 0.5 : 1;
  } catch (error) {
    return noPicture(error.message);
  }
  listen();
  controls();
  await wanted();
  if (!matchMedia("(prefers-reduced-motion: reduce)").matches) turnSlowly(performance.now());
}

// for tests and external scripts
window.skindb = {
  state, redraw, choose, stop, painter: () => painter, isTurning: () => turning !== null,
  draw: () => { while (painter.draw(state) < 1); },
  amounts: (values) => { if (values) { amounts = values; applyTraits(); redraw(); } return amounts; },
};
window.skindb.ready = start();
