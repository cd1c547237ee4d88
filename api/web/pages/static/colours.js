// Light, dark or as the system: switched in place. Charts draw themselves again on the window's event "colours".
"use strict";
function colourOf(name) { // the custom property itself keeps its light-dark() as it is written
  document.head.style.color = `var(--${name})`;
  return getComputedStyle(document.head).color;
}
{
  const page = document.documentElement, tell = () => dispatchEvent(new Event("colours"));

  function choose(name) {
    document.cookie = `stimrig_colours=${name}; path=/; max-age=31536000; samesite=lax`;
    page.dataset.colours = name;
    for (const button of document.querySelectorAll("[name=colours]")) button.setAttribute("aria-pressed", String(button.value === name));
    tell();
  }

  document.addEventListener("click", (event) => {
    const button = event.target.closest?.("[name=colours]");
    if (button) choose(button.value);
  });

  let kept = page.dataset.colours;
  addEventListener("beforeprint", () => { kept = page.dataset.colours; page.dataset.colours = "light"; tell(); }); // paper is white
  addEventListener("afterprint", () => { page.dataset.colours = kept; tell(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", tell);
}
