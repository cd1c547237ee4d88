// Follows long work, and what is next for a participant; loads the page anew once it has news.
"use strict";
const ANSWER_MS = 30000; // by then the answer to what was pressed is here, or it was a download
let pressed = -ANSWER_MS; // a form was sent (the stop by rig.js, where the page is old), or a link followed
addEventListener("submit", (event) => { if (!event.defaultPrevented || event.target.id === "stop-form") pressed = performance.now(); });
addEventListener("beforeunload", () => { pressed = performance.now(); });
addEventListener("pageshow", (event) => { if (event.persisted) pressed = -ANSWER_MS; });

// Meanwhile the page is not loaded anew, by live.js neither. It is asked again later: only a service that answers can give another page.
const answering = () => act.busy() || performance.now() - pressed < ANSWER_MS;

// What somebody has begun to write is not taken away: then they say when the page is read anew.
function arrive(box) {
  const fields = [...document.querySelectorAll("input:not([type=hidden], [type=checkbox], [type=radio]), textarea")];
  if (!fields.some((field) => field === document.activeElement || field.value !== field.defaultValue)) { location.reload(); return; }
  box.querySelector("[data-words]").textContent = "This page has news. "; // a result, or that it was cancelled, or that nobody is signed in
  box.querySelector("[data-left]").replaceChildren(act.make("button", { type: "button", textContent: "Show it", onclick: () => location.reload() }));
}

async function followJob(box) {
  for (;;) {
    await new Promise((resolve) => setTimeout(resolve, 400));
    try {
      const answer = await fetch("/v1/jobs/" + box.dataset.job, { headers: { Accept: "application/json" } }), job = answer.ok ? await answer.json() : null;
      if (job) {
        box.querySelector("progress").value = job.progress;
        if (job.text) box.querySelector("[data-words]").textContent = job.text;
        box.querySelector("[data-left]").textContent = job.time_left_s === null ? "" : job.time_left_s === 0 ? "takes longer than expected" : `about ${Math.ceil(job.time_left_s)} s left`;
      }
      if ((job ? job.done : answer.status < 500) && !answering()) { arrive(box); return; } // the page says what comes next
    } catch { /* the service may be starting again */ }
  }
}

// The line that says what is next, and the card of a controller's trials: asked for when the rig does something else, and every few seconds.
function followNext(box) {
  let rig = null, asking = false;
  async function ask() {
    if (asking) return;
    asking = true;
    try {
      const answer = await fetch(box.dataset.from, { cache: "no-store" }), now = answer.ok ? await answer.json() : null, trials = document.getElementById("trials");
      const held = trials?.contains(document.activeElement) && document.activeElement.tagName !== "SUMMARY";
      if (now && now.key !== box.dataset.nextKey && !answering()) arrive(box);
      else if (now && trials && now.trials !== trials.dataset.trials && !held) await renewTrials(trials.querySelector(".notice")?.textContent);
    } catch { /* asked again */ }
    asking = false;
  }
  document.addEventListener("rig", ({ detail }) => {
    const now = `${detail.state} ${detail.test?.id}`;
    if (now !== rig) ask();
    rig = now;
  });
  setInterval(() => { if (!document.hidden) ask(); }, box.dataset.nextKey.startsWith("identifying") ? 1000 : 2000);
}

async function renewTrials(question) { // a question that was read aloud is not read again
  await act.renew(["trials"]);
  const notice = document.querySelector("#trials .notice");
  if (notice?.textContent === question) notice?.removeAttribute("role");
}

for (const box of document.querySelectorAll("[data-job]")) followJob(box);
for (const box of document.querySelectorAll("[data-next-key]")) followNext(box);
