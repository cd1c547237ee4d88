// Follows long work and goes on once it is done.
"use strict";
const said = JSON.parse(document.getElementById("rig-words").textContent);
for (const box of document.querySelectorAll("[data-job]")) follow(box);
for (const box of document.querySelectorAll("[data-next]")) watch(box);

// The line that says what is next: asked for again when the rig does something else, and while a model is being made.
function watch(box) {
  let seen = null, asking = false;
  async function ask() {
    if (asking) return;
    asking = true;
    try {
      const answer = await fetch(box.dataset.from, { cache: "no-store" });
      if (answer.ok && (await answer.json()).key !== box.dataset.next) arrive(box.querySelector("[data-words]"), box.querySelector("[data-left]"));
    } catch { /* asked again */ }
    asking = false;
  }
  document.addEventListener("rig", ({ detail }) => {
    const now = detail.state + " " + (detail.test ? detail.test.id : "");
    if (now !== seen) ask();
    seen = now;
  });
  if (box.dataset.next.startsWith("identifying")) setInterval(ask, 1000);
}

async function follow(box) {
  const bar = box.querySelector("progress"), words = box.querySelector("[data-words]"), left = box.querySelector("[data-left]");
  for (;;) {
    await new Promise((resolve) => setTimeout(resolve, 400));
    let job;
    try {
      const answer = await fetch("/jobs/now/" + box.dataset.job, { headers: { Accept: "application/json" } });
      if (!answer.ok) { arrive(words, left); return; }
      job = await answer.json();
    } catch { continue; } // the service may be starting again
    bar.value = job.progress;
    if (job.text) words.textContent = job.text;
    left.textContent = job.time_left_s === null ? "" : job.time_left_s < 1 ? said.nearly : said.left.replace("{seconds}", Math.ceil(job.time_left_s));
    if (job.done) { arrive(words, left); return; } // the page says what comes next
  }
}

// What somebody has begun to write is not taken away: then they say when the page is read anew.
function arrive(words, left) {
  if (!begun()) { location.reload(); return; }
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = said.show;
  button.addEventListener("click", () => location.reload());
  words.textContent = said.news + " "; // a result, or that it was cancelled, or that nobody is signed in
  left.replaceChildren(button);
}

function begun() {
  const fields = [...document.querySelectorAll("input:not([type=hidden]):not([type=checkbox]):not([type=radio]), textarea")];
  return fields.some((field) => field === document.activeElement || field.value !== field.defaultValue);
}
