// The colours of page.css as they are now. Charts draw themselves again on the window's event "colours".
"use strict";
function colourOf(name) { // the custom property itself keeps its light-dark() as it is written
  document.head.style.color = `var(--${name})`;
  return getComputedStyle(document.head).color;
}
for (const query of ["(prefers-color-scheme: dark)", "print"]) matchMedia(query).addEventListener("change", () => dispatchEvent(new Event("colours")));
