// Light, dark or as the system: switched in place. Charts draw themselves again on the window's event "colours".
"use strict";
{
  const sheet = document.getElementById("dark");
  const media = JSON.parse(sheet.dataset.media);
  const tell = () => dispatchEvent(new Event("colours"));

  function choose(name) {
    document.cookie = `stimrig_colours=${name}; path=/; max-age=31536000; samesite=lax`;
    sheet.media = media[name];
    for (const button of document.querySelectorAll("[name=colours]")) button.setAttribute("aria-pressed", String(button.value === name));
    tell();
  }

  addEventListener("submit", (event) => { // where scripts are off the form is sent
    const button = event.submitter;
    if (!button || button.name !== "colours") return;
    event.preventDefault();
    event.stopImmediatePropagation(); // nobody leaves the page
    choose(button.value);
  }, true);

  let kept = sheet.media;
  addEventListener("beforeprint", () => { kept = sheet.media; sheet.media = "not all"; tell(); }); // paper is white
  addEventListener("afterprint", () => { sheet.media = kept; tell(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", tell);
  sheet.addEventListener("load", tell);
}
