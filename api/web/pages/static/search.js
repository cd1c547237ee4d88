// The list of participants follows what is typed; without scripts the form's button does.
"use strict";
{
  const field = document.getElementById("q"), form = document.getElementById("search");
  let waiting = 0, asked = 0;

  async function look() {
    const address = "/?" + new URLSearchParams(new FormData(form)), mine = ++asked;
    try {
      const answer = await fetch(address, { cache: "no-store", headers: { Accept: "text/html" } });
      if (mine !== asked || !answer.ok || answer.redirected) return; // an older answer, or the session is over
      const page = new DOMParser().parseFromString(await answer.text(), "text/html");
      const found = page.getElementById("list");
      if (found && mine === asked) { document.getElementById("list").replaceWith(found); history.replaceState(null, "", address); }
    } catch { /* the button still searches */ }
  }

  if (field) field.addEventListener("input", () => { clearTimeout(waiting); waiting = setTimeout(look, 150); });
}
