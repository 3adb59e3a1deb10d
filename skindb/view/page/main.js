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
const REST_MS = 300;  // a movement has ended after this time without another change
const state = {
  azimuth: 0, elevation: 0, distance: 700, tangent: 0.2, exposure: 1, softness: 1.5, divider: 1, component: 0,
  withDiffuse: true, withSurface: true, glow: true, background: [0.07, 0.07, 0.08], lights: [], surroundings: [],
};
const around = { on: false, turn: 0, power: 1 };  // light from all directions
let painter = null, face = null, amounts = [], active = 0, pending = false, moving = null;

function say(text) { $("status").textContent = text; }

function redraw() {
  if (pending || !painter) return;
  pending = true;
  requestAnimationFrame(() => {
    pending = false;
    resize();
    if (painter.draw(state) < 1) redraw();
  });
}

// For drawing while something moves. Without a graphics card a quarter of the pixels is drawn until it stops.
function redrawMoving() {
  if (painter && painter.software) {
    clearTimeout(moving);
    moving = setTimeout(() => { moving = null; redraw(); }, REST_MS);
  }
  redraw();
}

function resize() {
  const canvas = $("canvas"), ratio = Math.min(window.devicePixelRatio || 1, 2) * (moving === null ? 1 : 0.5);
  const width = Math.max(Math.round(canvas.clientWidth * ratio), 1), height = Math.max(Math.round(canvas.clientHeight * ratio), 1);
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
}

function stop() {
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
  const presets = [[35, 30], [-60, 10], [180, 40], [-20, 70]];
  const [azimuth, elevation] = presets[state.lights.length % presets.length];
  return { azimuth, elevation, distance: face.lightDistance, intensity: face.lightIntensity, power: 1 };
}

// lights of the surroundings in the form that the painter expects: far away, rotated about the vertical
function surroundings() {
  if (!around.on) return [];
  const far = 100 * face.radius, turn = (around.turn * Math.PI) / 180, found = face.surroundings;
  const total = found.irradiance.reduce((sum, one) => sum + one[1], 0);
  return found.direction.map(([x, y, z], i) => {
    const towards = [Math.cos(turn) * x + Math.sin(turn) * z, y, Math.cos(turn) * z - Math.sin(turn) * x];
    const intensity = found.irradiance[i].map((e) => e * far * far);
    return { position: add(face.centre, towards, far), intensity, power: around.power, weight: (around.power * found.irradiance[i][1]) / total };
  });
}

function showSurroundings() {
  state.surroundings = surroundings();
  redraw();
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
  $("fewer").disabled = state.lights.length < (around.on ? 1 : 2);
  $("more").disabled = state.lights.length >= MAX_LIGHTS;
}

function showDivider() {
  const cut = $("cut");
  cut.hidden = !face.traits.length || state.divider <= 0 || state.divider >= 1;
  cut.style.left = `${100 * state.divider}%`;
}

function applyTraits() {
  if (!face.traits.length) return;
  painter.update("edited", editedValues(face, amounts), amounts.some(Boolean));
}

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
    note.textContent = `The albedo is interpolated between 0 and ${full}; at ${full / 2} its median error is ${(100 * trait.error).toFixed(1)} % of the albedo.`;
    box.append(note);
  });
  state.divider = face.traits.length ? 0.5 : 1;
  $("divider").value = state.divider;
  showDivider();
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
    if (!state.lights.length && !around.on) state.lights = [newLight()];
    state.surroundings = surroundings();
    showLights();
    showTraits();
    showAbout();
    $("translucent").disabled = !face.translucent || !painter.glows;
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
  let span = 0;
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, event);
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    const dx = event.clientX - last.clientX, dy = event.clientY - last.clientY;
    pointers.set(event.pointerId, event);
    if (pointers.size === 2) {
      const [a, b] = [...pointers.values()], now = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
      if (span) zoom(span / now);
      span = now;
    } else if (event.shiftKey || event.buttons === 2) turnLight(0.4 * dx, -0.4 * dy);
    else turnView(-0.4 * dx, 0.4 * dy);
  });
  for (const kind of ["pointerup", "pointercancel"])
    canvas.addEventListener(kind, (event) => { pointers.delete(event.pointerId); span = 0; });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(event.deltaY * 0.001)); }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const step = 5, turn = event.shiftKey ? turnLight : turnView;
    const keys = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
    if (keys[event.key]) turn(...keys[event.key]);
    else if (event.key === "+" || event.key === "=") zoom(1 / 1.1);
    else if (event.key === "-") zoom(1.1);
    else if (event.key === "0") { state.azimuth = state.elevation = 0; redraw(); }
    else return;
    event.preventDefault();
  });
  canvas.addEventListener("webglcontextlost", (event) => { event.preventDefault(); say("The graphics context was lost and is being restored ..."); });
  canvas.addEventListener("webglcontextrestored", () => {
    painter.prepare();
    painter.tableA = painter.tableB = null;
    painter.load(face);
    applyTraits();
    say("The graphics context was restored.");
    redraw();
  });
  window.addEventListener("resize", redraw);
}

function turnView(across, up) {
  state.azimuth = ((state.azimuth + across + 540) % 360) - 180;
  state.elevation = Math.min(Math.max(state.elevation + up, -85), 85);
  redrawMoving();
}

function turnLight(across, up) {
  const light = state.lights[active] || state.lights[0];
  if (!light) return;  // only the surroundings shine
  light.azimuth = ((light.azimuth + across + 540) % 360) - 180;
  light.elevation = Math.min(Math.max(light.elevation + up, -89), 89);
  for (const name of ["azimuth", "elevation"]) {
    light.inputs[name].value = light[name];
    light.inputs[name].dispatchEvent(new Event("input"));
  }
}

function zoom(factor) {
  state.distance = Math.min(Math.max(state.distance * factor, 1.6 * face.radius), 20 * face.radius);
  redrawMoving();
}

function controls() {
  Object.keys(COMPONENTS).forEach((name, i) => $("component").append(new Option(name, i)));
  $("component").addEventListener("change", (event) => {
    state.component = Number(event.target.value);
    $("legend").textContent = Object.values(COMPONENTS)[state.component];
    redraw();
  });
  for (const [id, key] of [["diffuse", "withDiffuse"], ["surface", "withSurface"], ["translucent", "glow"]])
    $(id).addEventListener("change", (event) => { state[key] = event.target.checked; redraw(); });
  $("around").addEventListener("change", (event) => {
    around.on = event.target.checked;
    if (!around.on && !state.lights.length) state.lights = [newLight()];
    showLights();
    showSurroundings();
  });
  slider($("surroundings"), "rotation", { min: -180, max: 180, step: 5, value: 0, unit: "°" }, (x) => { around.turn = x; state.surroundings = surroundings(); });
  slider($("surroundings"), "power of the surroundings", { min: 0, max: 3, step: 0.05, value: 1 }, (x) => { around.power = x; state.surroundings = surroundings(); });
  slider($("camera"), "exposure", { min: 0.1, max: 4, step: 0.05, value: 1 }, (x) => { state.exposure = x; });
  slider($("camera"), "softness of shadows", { min: 0, max: 6, step: 0.5, value: 1.5 }, (x) => { state.softness = x; });
  $("divider").addEventListener("input", (event) => { state.divider = Number(event.target.value); showDivider(); redrawMoving(); });
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
  } catch (error) {
    return noPicture(error.message);
  }
  listen();
  controls();
  await wanted();
}

// for tests and external scripts
window.skindb = { state, redraw, choose, draw: () => { while (painter.draw(state) < 1); }, around, showSurroundings, painter: () => painter, amounts: (values) => { if (values) { amounts = values; applyTraits(); redraw(); } return amounts; }, stop };
window.skindb.ready = start();
