// The session under the pointer: its figures beside it, its column in every picture; a click opens its model.
"use strict";
{
  const box = document.querySelector(".trends");
  const tip = document.getElementById("tip");
  const columns = [...box.querySelectorAll(".column")];
  const show = (column, event) => {
    for (const each of columns) each.classList.toggle("here", column !== null && each.dataset.session === column.dataset.session);
    tip.hidden = column === null;
    if (column === null) return;
    tip.textContent = column.dataset.tip;
    const frame = box.getBoundingClientRect();
    const left = Math.min(event.clientX - frame.left + 14, frame.width - tip.offsetWidth - 8);
    tip.style.left = `${Math.max(8, left)}px`;
    tip.style.top = `${event.clientY - frame.top + 16}px`;
  };
  box.addEventListener("pointermove", (event) => show(event.target.closest(".column"), event));
  box.addEventListener("pointerleave", () => show(null));
  box.addEventListener("click", (event) => {
    const column = event.target.closest(".column");
    if (column) location.href = column.dataset.href;
  });
}
