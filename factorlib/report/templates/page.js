// What the page does beside the viewer: cut between photo and re-synthesis, expose the maps, copy a material's numbers.
(() => {
document.documentElement.classList.add("scripted");

// ── Photo and re-synthesis in one picture ────────────────────────────────────────────────────────────────────────────

for (const panels of document.querySelectorAll(".panels")) {
  const [photo, again] = ["photo", "re-synthesis"].map((title) => panels.querySelector(`[data-panel="${title}"] img`));
  if (!photo || !again) continue;
  const cut = document.createElement("div"), over = photo.cloneNode(), slider = document.createElement("input");
  cut.className = "cut";
  again.replaceWith(cut); cut.append(again, over);
  over.alt = ""; // the photo's own panel says what it is
  Object.assign(slider, { type: "range", min: 0, max: 100, step: 1, value: 0 });
  slider.setAttribute("aria-label", `share of ${photo.alt} over the re-synthesis, from the left`);
  const moved = () => { over.style.clipPath = `inset(0 ${100 - slider.value}% 0 0)`; };
  slider.addEventListener("input", moved);
  cut.after(slider);
  cut.parentElement.querySelector("figcaption").append(" – slide to lay the photo over it");
  moved();
}

// ── Environment maps ─────────────────────────────────────────────────────────────────────────────────────────────────

const ROWS = 128, COLUMNS = 256;
const drawn = new Map();
const lights = viewer_data?.lights ?? {};

// Radiance by texel, y up: the middle of the picture is +z, +x a quarter of the width from the left.
function lat_long(light) {
  const out = new Float32Array(3 * ROWS * COLUMNS);
  for (let row = 0, k = 0; row < ROWS; row++)
    for (let column = 0; column < COLUMNS; column++, k++) {
      const theta = Math.PI * (row + 0.5) / ROWS, phi = Math.PI * (1 - 2 * (column + 0.5) / COLUMNS), s = Math.sin(theta);
      add_radiance(light.lobes, s * Math.sin(phi), Math.cos(theta), s * Math.cos(phi), out, k);
    }
  return out;
}

const encoded = (v) => 255 * (v <= 0.0031308 ? 12.92 * v : 1.055 * Math.pow(Math.min(v, 1), 1 / 2.4) - 0.055);

function expose(figure, factor) {
  const name = figure.dataset.light, place = figure.querySelector(".map");
  if (!lights[name]) return;
  if (!drawn.has(name)) {
    const canvas = Object.assign(document.createElement("canvas"), { width: COLUMNS, height: ROWS });
    canvas.setAttribute("role", "img"); canvas.setAttribute("aria-label", place.querySelector("img").alt);
    place.querySelector("img").replaceWith(canvas);
    drawn.set(name, { canvas, radiance: lat_long(lights[name]) });
  }
  const { canvas, radiance } = drawn.get(name), context = canvas.getContext("2d"), pixels = context.createImageData(COLUMNS, ROWS);
  for (let k = 0; k < ROWS * COLUMNS; k++) {
    for (let c = 0; c < 3; c++) pixels.data[4 * k + c] = encoded(factor * radiance[3 * k + c]);
    pixels.data[4 * k + 3] = 255;
  }
  context.putImageData(pixels, 0, 0);
}

const maps = [...document.querySelectorAll("[data-light]")], stops = document.getElementById("maps-stops"), known = document.getElementById("maps-known");
let asked = 0;
stops?.addEventListener("input", () => {
  document.getElementById("maps-value").textContent = stops.value;
  const request = ++asked, queue = [...maps]; // one map a frame, and only for the slider's last place
  const next = () => {
    if (request !== asked || queue.length === 0) return;
    const figure = queue.shift();
    expose(figure, Math.pow(2, stops.value) / figure.dataset.white);
    requestAnimationFrame(next);
  };
  next();
});
known?.addEventListener("input", () => {
  for (const figure of maps) {
    const map = figure.querySelector(".map"), source = figure.querySelector("img.known");
    map.querySelector(".over")?.remove();
    if (!known.checked || !source) continue;
    const over = source.cloneNode();
    over.className = "over"; over.alt = "";
    map.append(over);
  }
});

// ── Copies ───────────────────────────────────────────────────────────────────────────────────────────────────────────

async function copy(text) {
  try { await navigator.clipboard.writeText(text); return true; } catch { /* an old browser, or not allowed */ }
  const area = document.createElement("textarea");
  area.value = text; document.body.append(area); area.select();
  const done = document.execCommand("copy");
  area.remove();
  return done;
}

for (const button of document.querySelectorAll("[data-copy]"))
  button.addEventListener("click", async () => {
    const done = await copy(button.dataset.copy), what = button.getAttribute("aria-label").replace(/^copy /, "");
    document.getElementById("copied").textContent = done ? `Copied ${what}.` : `The browser did not allow the copy; here it is: ${button.dataset.copy}`;
  });
})();
