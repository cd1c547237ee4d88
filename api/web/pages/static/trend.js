// The session under the pointer: its value beside it, its column in every picture; a click opens its model.
"use strict";
{
  const box = document.querySelector(".trends");
  const tip = document.getElementById("tip");
  const sessions = JSON.parse(document.getElementById("told").textContent); // of each: x, when, what else, its page
  const columns = [...box.querySelectorAll(".column")];

  // The number of the session that is nearest to the pointer in its picture; −1 where the pointer is in none.
  function nearest(event) {
    const picture = event.target.closest("svg.trend");
    if (!picture) return -1;
    const { x } = new DOMPoint(event.clientX, event.clientY).matrixTransform(picture.getScreenCTM().inverse());
    const far = sessions.map((session) => Math.abs(session[0] - x));
    return far.indexOf(Math.min(...far));
  }

  function show(number, event) {
    for (const each of columns) {
      each.classList.toggle("here", number >= 0);
      if (number >= 0) each.setAttribute("x", sessions[number][0] - 4);
    }
    tip.hidden = number < 0;
    if (number < 0) return;
    const value = JSON.parse(event.target.closest("svg.trend").dataset.words)[number];
    tip.textContent = [sessions[number][1], value, sessions[number][2]].join("\n");
    const frame = box.getBoundingClientRect();
    const left = Math.min(event.clientX - frame.left + 14, frame.width - tip.offsetWidth - 8);
    tip.style.left = `${Math.max(8, left)}px`;
    tip.style.top = `${event.clientY - frame.top + 16}px`;
  }
  box.addEventListener("pointermove", (event) => show(nearest(event), event));
  box.addEventListener("pointerleave", (event) => show(-1, event));
  box.addEventListener("click", (event) => { const number = nearest(event); if (number >= 0) location.href = sessions[number][3]; });
}
