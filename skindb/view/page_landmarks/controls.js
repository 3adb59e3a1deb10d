// The list of points, the sliders of the crop box, and pointer and keyboard events of the picture.
"use strict";

const AXES = ["x", "y", "z"];
const MAX_CLICK_MOVE = 4;  // px; a pointer that moves farther turns the view
const GRAB = 9;  // px; a point within this distance of the pointer is dragged

function element(kind, properties, ...children) {
  const made = Object.assign(document.createElement(kind), properties);
  made.append(...children);
  return made;
}

// one line for each point, with its name, its state and buttons
function showList(list, state, actions) {
  const focused = document.activeElement && document.activeElement.dataset ? document.activeElement.dataset.key : null;
  list.replaceChildren(...Object.entries(state.names).map(([name, sentence]) => {
    const kind = name in state.points ? "set" : name in state.suggestions ? "suggested" : "open";
    const button = (label, act) => {
      const made = element("button", { type: "button", textContent: label, onclick: () => act(name) });
      made.setAttribute("aria-label", `${label} ${name}`);
      made.dataset.key = `${label} ${name}`;
      return made;
    };
    const choose = element("button", { type: "button", className: "name", textContent: name.replaceAll("_", " ") });
    choose.onclick = () => actions.select(name);
    choose.dataset.key = name;
    const line = element("li", { className: kind }, choose, element("span", { textContent: kind, className: "kind" }));
    if (kind === "suggested") line.append(button("Accept", actions.accept));
    if (kind === "set") line.append(button("Remove", actions.remove));
    line.append(element("p", { textContent: sentence }));
    if (name === state.selected) {
      line.classList.add("next");
      choose.setAttribute("aria-current", "true");
    }
    return line;
  }));
  const again = focused && [...list.querySelectorAll("button")].find((one) => one.dataset.key === focused);
  if (again) again.focus();
}

function cropSliders(place, state, changed) {
  const { low, high } = state.bounds;
  for (const [i, axis] of AXES.entries())
    for (const end of ["low", "high"]) {
      const shown = element("output", {}), least = Math.floor(low[i]), most = Math.ceil(high[i]);
      const slider = element("input", { type: "range", min: least, max: most, step: 1 });
      slider.id = `crop-${axis}-${end}`;
      const show = () => { slider.value = state.box[end][i]; shown.textContent = `${Math.round(state.box[end][i])}`; };
      slider.oninput = () => {
        const value = Number(slider.value), other = state.box[end === "low" ? "high" : "low"][i];
        state.box[end][i] = end === "low" ? Math.min(value, other - 1) : Math.max(value, other + 1);
        show();
        changed();
      };
      show();
      place.append(element("label", {}, `${axis} ${end === "low" ? "from" : "to"} `, slider, shown));
    }
}

// the box in the form that the server expects; null if it contains the whole scan
function chosenBox({ box, bounds: { low, high } }) {
  const whole = AXES.every((_, i) => box.low[i] <= low[i] && box.high[i] >= high[i]);
  return whole ? null : { low: box.low, high: box.high };
}

function turn(view, across, above) {
  view.azimuth -= across;
  view.elevation = Math.max(-85, Math.min(85, view.elevation + above));
}

function zoom(view, factor) {
  view.distance = Math.max(view.size / 20, Math.min(view.size * 8, view.distance * factor));
}

// moves the target of the view with the pointer
function shift(canvas, view, x, y) {
  const { right, up } = frame(view), mm = (2 * TANGENT * view.distance) / canvas.getBoundingClientRect().height;
  view.target = add(add(view.target, right, -x * mm), up, y * mm);
}

// `actions`: click(x, y); grab(x, y), which returns the name of a point or null; drag(name, x, y); drop(); draw()
function listen(canvas, view, actions) {
  const fingers = new Map();
  let moved = 0, held = null, apart = 0;
  const at = (event) => {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  const spread = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
  canvas.onpointerdown = (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, at(event));
    if (fingers.size === 1) [moved, held] = [0, event.button === 0 && !event.shiftKey ? actions.grab(...at(event)) : null];
    else [moved, held, apart] = [Infinity, null, spread()];
  };
  canvas.onpointermove = (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const now = at(event), [x, y] = sub(now, before);
    fingers.set(event.pointerId, now);
    moved += Math.hypot(x, y);
    if (fingers.size === 2) {
      zoom(view, apart / spread());
      apart = spread();
    } else if (moved <= MAX_CLICK_MOVE) return;
    else if (held) actions.drag(held, ...now);
    else if (event.shiftKey || event.buttons & 2) shift(canvas, view, x, y);
    else turn(view, 0.4 * x, 0.4 * y);
    actions.draw();
  };
  const lift = (event) => {
    if (!fingers.delete(event.pointerId) || fingers.size) return;
    if (event.type === "pointerup" && moved <= MAX_CLICK_MOVE && event.button === 0 && !held) actions.click(...at(event));
    else if (held && moved > MAX_CLICK_MOVE) actions.drop();
    else if (held) actions.select(held);
    held = null;
  };
  canvas.onpointerup = canvas.onpointercancel = lift;
  canvas.oncontextmenu = (event) => event.preventDefault();
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(view, Math.exp(event.deltaY / 600));
    actions.draw();
  }, { passive: false });
  canvas.onkeydown = (event) => {
    const box = canvas.getBoundingClientRect(), step = event.shiftKey ? (x, y) => shift(canvas, view, 20 * x, 20 * y) : (x, y) => turn(view, 5 * x, 5 * y);
    const keys = {
      ArrowLeft: () => step(-1, 0), ArrowRight: () => step(1, 0), ArrowUp: () => step(0, -1), ArrowDown: () => step(0, 1),
      "+": () => zoom(view, 0.9), "-": () => zoom(view, 1 / 0.9), 0: () => actions.front(),
      Enter: () => actions.click(box.width / 2, box.height / 2),
    };
    if (!(event.key in keys) || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    keys[event.key]();
    actions.draw();
  };
}
