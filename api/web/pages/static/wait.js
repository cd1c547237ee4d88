// Follows long work and goes on once it is done.
"use strict";
for (const box of document.querySelectorAll("[data-job]")) follow(box);

async function follow(box) {
  const bar = box.querySelector("progress"), words = box.querySelector("[data-words]"), left = box.querySelector("[data-left]");
  for (;;) {
    await new Promise((resolve) => setTimeout(resolve, 400));
    let job;
    try {
      const answer = await fetch("/v1/jobs/" + box.dataset.job, { headers: { Accept: "application/json" } });
      if (!answer.ok) { arrive(words, left); return; }
      job = await answer.json();
    } catch { continue; } // the service may be starting again
    bar.value = job.progress;
    words.textContent = job.text || words.textContent;
    left.textContent = job.time_left_s === null ? "" : job.time_left_s < 1 ? "nearly done" : "about " + Math.ceil(job.time_left_s) + " s left";
    if (job.done) { arrive(words, left); return; } // the page says what comes next
  }
}

// What somebody has begun to write is not taken away: then they say when the page is read anew.
function arrive(words, left) {
  if (!begun()) { location.reload(); return; }
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = "Show it";
  button.addEventListener("click", () => location.reload());
  words.textContent = "This page has news. "; // a result, or that it was cancelled, or that nobody is signed in
  left.replaceChildren(button);
}

function begun() {
  const fields = [...document.querySelectorAll("input:not([type=hidden]):not([type=checkbox]):not([type=radio]), textarea")];
  return fields.some((field) => field === document.activeElement || field.value !== field.defaultValue);
}
