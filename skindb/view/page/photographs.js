// Photographs of the dome over the model under the same light, as a wipe or as their difference.
"use strict";

const GAP_SCALE = 0.25;  // of the displayed range, shown yellow
let photograph = null, beforehand = null;  // what is shown, and the state before it

function showPhotographs() {
  leavePhotograph();
  $("photographs").hidden = !face.photographs.length;
  $("thumbnails").replaceChildren(...face.photographs.map((one) => {
    const button = document.createElement("button"), picture = new Image();
    picture.src = one.picture;
    picture.alt = `${one.name}${one.held_out ? ", not seen by the fit" : ""}`;
    button.title = picture.alt;
    button.type = "button";
    button.append(picture);
    button.addEventListener("click", () => (photograph === one ? leavePhotograph() : choosePhotograph(one)));
    return button;
  }));
}

function choosePhotograph(one) {
  if (!beforehand) beforehand = { ...state };
  photograph = one;
  Object.assign(state, {
    through: one.camera, lights: [one.light], around: { ...state.around, on: false }, exposure: one.exposure / face.exposure,
    toned: false, background: null, divider: 1, component: 0,
  });
  $("photo").src = one.picture;
  markPhotograph(`${one.name}: ${one.held_out ? "not seen by the fit" : "used by the fit"}`);
}

function leavePhotograph() {
  if (!photograph) return;
  Object.assign(state, { through: null }, beforehand);
  photograph = beforehand = null;
  markPhotograph("");
}

function markPhotograph(text) {
  document.body.classList.toggle("compared", photograph !== null);
  [...$("thumbnails").children].forEach((button, i) => button.setAttribute("aria-pressed", String(face.photographs[i] === photograph)));
  $("photographed").textContent = text;
  showDivider();
  redraw();
}

// after each picture of the model
function placePhotograph() {
  if (!photograph) return;
  const canvas = $("canvas"), image = $("photo"), gap = $("difference"), view = { width: canvas.clientWidth, height: canvas.clientHeight };
  const { width, height } = photograph.camera, { scale, left, top } = fitted({ width, height }, view);
  Object.assign(image.style, { left: `${left}px`, top: `${top}px`, width: `${scale * width}px`, height: `${scale * height}px` });
  $("overlay").style.clipPath = `inset(0 ${100 * (1 - Number($("wipe").value))}% 0 0)`;
  image.hidden = $("gap").checked;
  gap.hidden = !image.hidden;
  if (!gap.hidden && image.complete) drawDifference(canvas, image, gap);
}

// mean of the channels of |model - photograph|, where both are known
function drawDifference(canvas, image, gap) {
  const { width, height } = canvas, [model, photo] = [0, 1].map(() => new OffscreenCanvas(width, height).getContext("2d"));
  const { scale, left, top } = fitted(photograph.camera, canvas);
  model.drawImage(canvas, 0, 0);
  photo.drawImage(image, left, top, scale * photograph.camera.width, scale * photograph.camera.height);
  const a = model.getImageData(0, 0, width, height), b = photo.getImageData(0, 0, width, height).data, out = a.data;
  for (let i = 0; i < out.length; i += 4) {
    const known = out[i + 3] > 250 && b[i + 3] > 250;
    const mean = (Math.abs(out[i] - b[i]) + Math.abs(out[i + 1] - b[i + 1]) + Math.abs(out[i + 2] - b[i + 2])) / 765;
    const level = known ? Math.min(mean / GAP_SCALE, 1) : 0;
    out[i] = 255 * Math.min(1.6 * level, 1);  // black, red, yellow
    out[i + 1] = 255 * Math.max(1.6 * level - 0.6, 0);
    out[i + 2] = known ? 20 : 0;
    out[i + 3] = 255;
  }
  Object.assign(gap, { width, height });
  gap.getContext("2d").putImageData(a, 0, 0);
}
