// A note while a test runs is written without leaving the page: its curves go on.
"use strict";
{
  const form = document.getElementById("note-form");

  async function write(event) {
    if (!form.querySelector("[name=now]")) return; // a test that is over: the form itself does
    event.preventDefault();
    event.stopPropagation(); // nobody leaves this page
    const given = new URLSearchParams(new FormData(form)), pressed = event.submitter;
    if (pressed && pressed.name) given.set(pressed.name, pressed.value);
    try {
      const answer = await fetch(form.action, { method: "POST", body: given, headers: { Accept: "text/html" } });
      const page = new DOMParser().parseFromString(await answer.text(), "text/html");
      const found = page.getElementById("notes-written") || page.querySelector("section [role=alert]");
      if (found) document.getElementById("notes-written").replaceChildren(...(answer.ok ? found.childNodes : [found]));
      if (answer.ok) form.querySelector("[name=text]").value = "";
    } catch { // what was typed stays, and so does the page
      const box = document.createElement("p");
      box.className = "notice bad"; box.setAttribute("role", "alert"); box.textContent = JSON.parse(document.getElementById("rig-words").textContent).not_written;
      document.getElementById("notes-written").replaceChildren(box);
    }
  }

  if (form) form.addEventListener("submit", write);
}
