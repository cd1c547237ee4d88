// What a still says under the pointer: the value of each line there, read from its path. In a file also a link to save it.
"use strict";
{
  const lang = document.documentElement.lang || "en";
  const known = new WeakMap();

  // A number as the chart's own words have it: `how` is sign|digits|unit.
  function written(value, how) {
    const [sign, digits, unit] = how.split("|");
    const places = { minimumFractionDigits: +digits, maximumFractionDigits: +digits };
    return value.toLocaleString(lang, { ...places, useGrouping: false, signDisplay: sign ? "always" : "auto" }).replace("-", "−") + unit;
  }

  // The stretches of a path without a gap, each as points in the still's own pixels.
  function runs(path) {
    if (!known.has(path)) known.set(path, path.getAttribute("d").split("M").slice(1).map((run) => {
      let x = 0, y = 0;
      return run.split("l").map((step) => { const [dx, dy] = step.match(/-?[\d.]+/g).map(Number); return [x += dx, y += dy]; });
    }));
    return known.get(path);
  }

  function heightAt(path, x) {
    for (const run of runs(path)) {
      const k = run.findIndex((point) => point[0] >= x);
      if (k < 1) continue;
      const [[x0, y0], [x1, y1]] = [run[k - 1], run[k]];
      return y0 + ((x - x0) / (x1 - x0 || 1)) * (y1 - y0);
    }
    return null;
  }

  const scaled = (words, px) => { const [first, at, each] = words.split(" ").map(Number); return first + (px - at) / each; };

  function show(event) {
    const box = event.target.closest?.(".figure-box"), still = box && box.querySelector("svg.still");
    for (const other of document.querySelectorAll(".read-out")) if (!still || !box.contains(other)) other.remove();
    if (!still || event.target.closest(".chart-tools")) return;
    const place = new DOMPoint(event.clientX, event.clientY).matrixTransform(still.getScreenCTM().inverse());
    const lines = [...still.querySelectorAll("[data-how]")].map((path) => [path, heightAt(path, place.x)]).filter(([, y]) => y !== null);
    const told = lines.map(([path, y]) => path.dataset.name + " " + written(scaled(path.dataset.y, y), path.dataset.how));
    if (still.dataset.how) told.unshift(written(scaled(still.dataset.x, place.x), still.dataset.how));
    const tip = box.querySelector(".read-out") || box.appendChild(Object.assign(document.createElement("p"), { className: "read-out" }));
    tip.hidden = !lines.length;
    tip.textContent = told.join("\n");
    const frame = box.getBoundingClientRect(), x = event.clientX - frame.left;
    tip.style.left = `${x + 14 + tip.offsetWidth < frame.width ? x + 14 : Math.max(0, x - 14 - tip.offsetWidth)}px`;
    tip.style.top = `${Math.max(0, Math.min(event.clientY - frame.top + 14, frame.height - tip.offsetHeight))}px`;
  }
  document.addEventListener("pointermove", show);

  for (const box of document.querySelectorAll(".figure-box:not([data-still])")) {
    const link = Object.assign(document.createElement("a"), { className: "save", download: box.dataset.figure + ".svg", textContent: "Save as SVG", href: "#" });
    link.onclick = () => { link.href = URL.createObjectURL(new Blob([box.querySelector("svg").outerHTML], { type: "image/svg+xml" })); };
    box.after(link);
  }
}
