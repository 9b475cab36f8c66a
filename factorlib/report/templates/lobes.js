// What the page was handed to relight, and light as a sum of lobes: used by the viewer and by the maps.
"use strict";
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;

// Null where nothing was exported.  Lobes become numbers, 7 a lobe: axis (y-up), sharpness, weight.
const viewer_data = (() => {
  const element = document.getElementById("viewer-data");
  if (!element) return null;
  const data = JSON.parse(element.textContent);
  for (const light of Object.values(data.lights)) light.lobes = new Float32Array(bytes(light.lobes));
  return data;
})();

// Add the sum of lobes w exp(-sharpness |d - axis|^2 / 2) in the unit direction d = (x, y, z) to out[3 k ...].
function add_radiance(lobes, x, y, z, out, k) {
  for (let j = 0; j < lobes.length; j += 7) {
    const e = 0.5 * lobes[j + 3] * ((x - lobes[j]) ** 2 + (y - lobes[j + 1]) ** 2 + (z - lobes[j + 2]) ** 2);
    if (e > 30) continue;
    const g = Math.exp(-e);
    out[3 * k] += g * lobes[j + 4]; out[3 * k + 1] += g * lobes[j + 5]; out[3 * k + 2] += g * lobes[j + 6];
  }
}
