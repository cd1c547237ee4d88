// The rig's state, on every page and in every tab: read twice a second, never shown when older than 2 s.
// The page asks (the service does not push): an answer is newer than its question, also after a laptop has slept.
"use strict";
{
  const EVERY_MS = 500, TIMEOUT_MS = 1500, OLD_MS = 2000, LONG_MS = 300000, TORQUE_OLD_S = 1.0, READ_MS = 2000, STOP_MS = 5000, AGAIN_MS = 250;
  const DOUBTS = {
    stopping: "Stop is being sent, but the service does not answer. Use the emergency switch on the stimulator.",
    not_stopped: "No answer to stop came. Use the emergency switch on the stimulator. Then press stop again.",
    no_answer: "The service has not answered since {time}. What stands here may have changed since. If stimulation may be on, use the emergency switch on the stimulator.",
    signed_out: "You have been signed out. What stands here is of {time} and may have changed since. The stop button still works.",
    out_of_touch: "This page heard nothing from {time} on. What stands here may have changed since.",
  };
  const clock = () => [performance.now(), Date.now()]; // the first stands still while a machine sleeps, the second may be set
  const since = (then) => Math.max(performance.now() - then[0], Date.now() - then[1]);
  const begun = clock(), doubt = document.getElementById("page-old"), person = document.querySelector(".who");
  let heard = doubt.dataset.at, lost = "", stop = "", stopTimer = 0; // when the page last heard of the service; why what it shows is old
  let known = null, answered = null, asked = null, asking = false, renewing = "";
  let shownStop = read("rearm"), hadFocus = false; // the stop whose re-arm this tab showed last, and since when if another was shown before

  const old = () => since(answered || begun) > OLD_MS;
  const fixed = (value, digits) => value.toFixed(digits).replace("-", "−");
  const boxes = (name) => document.querySelectorAll(`[data-now="${name}"]`);
  const say = (name, text) => { for (const box of boxes(name)) if (box.textContent !== text) box.textContent = text; };

  async function ask() {
    if (asking || document.hidden) return;
    asking = true;
    const moment = asked = clock();
    try {
      const answer = await fetch("/rig/now", { cache: "no-store", signal: AbortSignal.timeout(TIMEOUT_MS) });
      if (answer.ok) { known = await answer.json(); touch(); answered = moment; dispatchEvent(new CustomEvent("rig-now", { detail: known })); }
    } catch { /* what is shown grows old, and says so */ }
    asking = false;
    show();
  }

  function touch() { // what was not heard of for long stays in doubt until the page is read anew
    if (person && known.signed_in === false) lost = "signed_out";
    else if (since(answered || begun) > LONG_MS || lost === "signed_out") lost = "out_of_touch"; // signed in again, in another tab: perhaps somebody else
    if (!lost) heard = known.at;
  }

  function show() {
    const why = stop || (document.getElementById("live") ? "" : old() ? "no_answer" : lost); // a running test's page says it itself
    const [words, signIn, anew] = doubt.children, text = (DOUBTS[why] || "").replace("{time}", heard);
    if (words.textContent !== text) words.textContent = text;
    doubt.hidden = !why; signIn.hidden = why !== "signed_out"; anew.hidden = why !== "out_of_touch";
    if (old()) { bar({ state: "unknown", flow: "Unknown", more: "no answer from the service", ready: false }); return; }
    if (!known) return; // what the service wrote into the page stands, with its time
    bar(known);
    document.dispatchEvent(new CustomEvent("rig", { detail: known })); // for scripts that follow what the rig does
    if (known.test !== undefined) showTest(known.test);
    if (known.notice !== undefined) renew(known.notice);
  }

  function bar({ state, flow, more, ready }) {
    document.getElementById("rig-state").className = "pill state-" + state;
    const angle_deg = old() || typeof known.angle_deg !== "number" ? NaN : known.angle_deg;
    const there = ({ dataset: { angleFrom, angleTo } }) => angleFrom === undefined || (angle_deg >= Number(angleFrom) && angle_deg <= Number(angleTo));
    say("flow", flow); say("more", more); say("at", ""); say("torque", torque()); say("angle", isNaN(angle_deg) ? "–" : fixed(angle_deg, 0) + "°");
    for (const box of document.querySelectorAll("[data-needs-ready]")) box.disabled = !ready || !there(box); // a held test begins only at its angle
    for (const box of document.querySelectorAll("[data-at-angle]")) box.classList.toggle("is-there", there(box));
  }

  function torque() {
    if (old()) return "unknown";
    if (typeof known.torque_age_s !== "number") return "none yet";
    const age_s = known.torque_age_s + since(answered) / 1000;
    return known.torque_nm === null || age_s > TORQUE_OLD_S ? `no torque for ${fixed(age_s, 1)} s` : `${fixed(known.torque_nm, 2)} N·m, ${fixed(age_s, 1)} s old`;
  }

  function showTest(test) {
    for (const box of document.querySelectorAll("[data-when]")) box.hidden = (box.dataset.when === "busy") !== (test !== null);
    for (const tag of document.querySelectorAll("[data-running]")) {
      if (test?.id === tag.dataset.running) continue;
      tag.textContent = "ended"; tag.className = "tag"; delete tag.dataset.running; // how, the page says when it is loaded
    }
    for (const link of test ? boxes("test") : []) link.setAttribute("href", "/tests/" + test.id);
    if (test) say("participant", test.participant);
  }

  // ---- the notice, with its button to re-arm -----------------------------------------------------------------------

  async function renew(key) {
    const notice = document.getElementById("rig-notice");
    if (!notice || notice.dataset.key === key || renewing === key) return;
    renewing = key; hadFocus = notice.contains(document.activeElement);
    await act.renew(["rig-notice"]).catch(() => {}); // the next answer asks again
    renewing = "";
  }

  function read(name) { try { return JSON.parse(sessionStorage.getItem(name)) || {}; } catch { return {}; } }

  // The page brings the button disabled. Another stop that came under the hand, here or as the page was loaded anew, is read before it can be pressed.
  function enableRearm() {
    const form = document.getElementById("rearm"), button = form?.querySelector("button"), latch = form?.dataset.ifMatch, back = hadFocus;
    if (!form) return;
    if (latch !== shownStop.latch) {
      shownStop = { latch, since: shownStop.latch ? Date.now() : 0 };
      try { sessionStorage.setItem("rearm", JSON.stringify(shownStop)); } catch { /* not kept */ }
    }
    const enable = () => { button.disabled = false; if (back && document.activeElement === document.body) button.focus(); };
    const left_ms = Math.min(READ_MS, READ_MS - (Date.now() - shownStop.since));
    if (left_ms > 0) setTimeout(enable, left_ms); else enable();
  }

  // ---- stop --------------------------------------------------------------------------------------------------------

  addEventListener("submit", (event) => {
    if (event.target.id !== "stop-form") return;
    event.preventDefault(); // where nobody answers a browser would leave the page, its stop button with it, for a page of its own
    stopTimer ||= setTimeout(notStopped, STOP_MS); // counted from the first press: who presses on must not wait longer
    send(event.target);
  });

  // Until it is answered. One that waits is not given up, nor is another sent beside it: the rig may need seconds to confirm it.
  async function send(form) {
    if (old()) stopping();
    while (stopTimer) await attempt(form);
  }

  async function attempt(form) {
    try {
      const answer = await fetch(form.action, { method: "POST", body: new URLSearchParams(new FormData(form)), headers: { Accept: "text/html" } });
      if (answer.status >= 500 && !answer.redirected) throw new Error("a proxy, without the service");
      clearTimeout(stopTimer); stopTimer = 0;
      if (answer.redirected) location.assign(answer.url); else form.submit();
    } catch { // a service that died is started again: so is the stop
      if (stopTimer) stopping();
      await pause(AGAIN_MS);
    }
  }

  const pause = (ms) => new Promise((done) => setTimeout(done, ms));
  function stopping() { stop = "stopping"; show(); }
  function notStopped() { clearTimeout(stopTimer); stopTimer = 0; stop = "not_stopped"; show(); }

  // ---- when it looks -----------------------------------------------------------------------------------------------

  const now = () => { show(); ask(); };
  setInterval(() => { if (!asked || since(asked) >= EVERY_MS) now(); else show(); }, 250);
  addEventListener("renewed", ({ detail }) => { if (detail.includes("rig-notice")) enableRearm(); }); // at once, before anything can be pressed
  addEventListener("pageshow", (event) => { if (event.persisted) location.reload(); else now(); }); // kept by Back: all of it is old
  document.addEventListener("visibilitychange", now);
  addEventListener("online", now);
  doubt.lastElementChild.addEventListener("click", () => location.reload());
  enableRearm();
  now();
}
