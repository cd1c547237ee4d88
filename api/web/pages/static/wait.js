// Follows long work and goes on once it is done.
"use strict";
const said = JSON.parse(document.getElementById("rig-words").textContent);
for (const box of document.querySelectorAll("[data-job]")) follow(box);
for (const box of document.querySelectorAll("[data-next-key]")) watch(box);

// The line that says what is next, and the card of a controller's trials: asked for again when the rig does something else, and every few seconds.
function watch(box) {
  const quick = box.dataset.nextKey.startsWith("identifying");
  let seen = null, asking = false;
  async function ask() {
    if (asking) return;
    asking = true;
    try {
      const answer = await fetch(box.dataset.from, { cache: "no-store" }), trials = document.getElementById("trials");
      const now = answer.ok ? await answer.json() : null;
      if (now && now.key !== box.dataset.nextKey && !answering()) arrive(box.querySelector("[data-words]"), box.querySelector("[data-left]"));
      else if (now && trials && now.trials !== trials.dataset.trials && !(trials.contains(document.activeElement) && document.activeElement.tagName !== "SUMMARY")) await renewTrials(trials);
    } catch { /* asked again */ }
    asking = false;
  }
  document.addEventListener("rig", ({ detail }) => {
    const now = detail.state + " " + (detail.test ? detail.test.id : "");
    if (now !== seen) ask();
    seen = now;
  });
  setInterval(() => { if (!document.hidden) ask(); }, quick ? 1000 : document.getElementById("trials") ? 2000 : 5000);
}

async function renewTrials(old) { // a table that was opened stays open, and a question that was read aloud is not read again
  const open = old.querySelector("details")?.open, question = old.querySelector(".notice")?.textContent;
  await act.renew(["trials"]);
  if (open) document.querySelector("#trials details")?.setAttribute("open", "");
  const notice = document.querySelector("#trials .notice");
  if (notice && notice.textContent === question) notice.removeAttribute("role");
}

async function follow(box) {
  const bar = box.querySelector("progress"), words = box.querySelector("[data-words]"), left = box.querySelector("[data-left]");
  for (;;) {
    await new Promise((resolve) => setTimeout(resolve, 400));
    let job;
    try {
      const answer = await fetch("/v1/jobs/" + box.dataset.job, { headers: { Accept: "application/json" } });
      if (answer.status >= 500) continue;
      if (!answer.ok && answering()) continue;
      if (!answer.ok) { arrive(words, left); return; }
      job = await answer.json();
    } catch { continue; } // the service may be starting again
    bar.value = job.progress;
    if (job.text) words.textContent = job.text;
    if (job.done && answering()) continue;
    if (job.done) { arrive(words, left); return; } // the page says what comes next
    left.textContent = job.time_left_s === null ? "" : job.time_left_s === 0 ? said.longer : said.left.replace("{seconds}", Math.ceil(job.time_left_s));
  }
}

const ANSWER_MS = 30000; // by then the answer to what was pressed is here, or it was a download
let pressed = -ANSWER_MS; // a form was sent (the stop by rig.js, where the page is old; a note, by a script, brings no answer), or a link followed
addEventListener("submit", (event) => { if (!event.defaultPrevented || event.target.id === "stop-form") pressed = performance.now(); });
addEventListener("beforeunload", () => { pressed = performance.now(); });
addEventListener("pageshow", (event) => { if (event.persisted) pressed = -ANSWER_MS; });

// Meanwhile the page is not loaded anew, by live.js neither. It is asked again later: only a service that answers can give another page.
const answering = () => act.busy() || performance.now() - pressed < ANSWER_MS;

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
