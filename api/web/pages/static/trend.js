// The session under the pointer: its value beside it, a mark in every panel; a click opens its model.
"use strict";
{
  const box = document.querySelector(".trends");
  const tip = document.getElementById("tip");
  const sessions = JSON.parse(document.getElementById("session-rows").textContent); // of each: day, when, what else, its page
  const stills = [...box.querySelectorAll("svg.still")];
  const left = (still, day) => { const [first, at, each] = still.dataset.x.split(" ").map(Number); return at + (day - first) * each; };

  // The number of the session that is nearest to the pointer in its panel; −1 where the pointer is in none.
  function nearest(event) {
    const still = event.target.closest("svg.still");
    if (!still) return -1;
    const { x } = new DOMPoint(event.clientX, event.clientY).matrixTransform(still.getScreenCTM().inverse());
    const far = sessions.map(([day]) => Math.abs(left(still, day) - x));
    return far.indexOf(Math.min(...far));
  }

  function show(number, event) {
    for (const mark of box.querySelectorAll("rect.column")) mark.remove();
    tip.hidden = number < 0;
    if (number < 0) return;
    for (const still of stills) still.insertAdjacentHTML("beforeend", `<rect class="column" x="${left(still, sessions[number][0]) - 4}" width="8" height="100%"/>`);
    const panel = event.target.closest(".panel");
    const value = panel.querySelector("b").textContent + " " + panel.dataset.values.split("\t")[number];
    tip.textContent = [sessions[number][1], value, sessions[number][2]].join("\n");
    const frame = box.getBoundingClientRect();
    tip.style.left = `${Math.max(8, Math.min(event.clientX - frame.left + 14, frame.width - tip.offsetWidth - 8))}px`;
    tip.style.top = `${event.clientY - frame.top + 16}px`;
  }
  box.addEventListener("pointermove", (event) => show(nearest(event), event));
  box.addEventListener("pointerleave", (event) => show(-1, event));
  box.addEventListener("click", (event) => { const number = nearest(event); if (number >= 0) location.href = sessions[number][3]; });
}
