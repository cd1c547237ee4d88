// Forms that call REST: `<form data-call="PUT /v1/...">`. Fields become JSON; the answer leads on, or is shown where it belongs.
// The attributes that it reads are listed in docs/decisions/0021-one-script.md.
"use strict";
const act = (() => {
  const TIMEOUT_MS = 30000, UPLOAD_TIMEOUT_MS = 600000, READ_MS = 2000;
  const NUMBER = /^[-−]?(?:0|[1-9]\d{0,4})(?:[.,]\d{1,2})?$/, WHOLE = /^(?:0|[1-9]\d{0,4})$/;
  let pending = 0, focused = "";

  const here = () => location.pathname + location.search;

  function make(tag, properties = {}, ...children) {
    const element = Object.assign(document.createElement(tag), properties);
    element.append(...children);
    return element;
  }

  // ---- reading a form ----------------------------------------------------------------------------------------------

  function readField(field, types) {
    const text = field.value.trim(), whole = types.includes("int");
    if (!types.some((type) => ["int", "number", "degrees"].includes(type))) return text;
    const unchanged = text && text === field.defaultValue && Number.isFinite(Number(text)); // the page's own, however fine
    if (!unchanged && !(whole ? WHOLE : NUMBER).test(text)) {
      const like = whole ? "a whole number; type one like 30" : "a plain number; type one like 9 or 9,5 or 9.5, with at most two digits behind the comma or point";
      throw Object.assign(new Error(`“${text}” is not ${like}`), { field });
    }
    const value = Number(text.replace("−", "-").replace(",", "."));
    return types.includes("degrees") ? (value * Math.PI) / 180 : value;
  }

  function readFields(fields) { // all of one name; undefined: nothing to send
    const last = fields.at(-1), types = (last.dataset.type || "").split(" "), filled = fields.filter((field) => field.value.trim());
    if (types[0] === "flag") return last.type === "checkbox" ? last.checked : last.value === "true";
    if (!filled.length) return last.dataset.empty === "null" ? null : undefined;
    if (types[0] === "list") return filled.flatMap((field) => field.value.trim().split(/[\s,]+/));
    return types.includes("list") ? fields.map((field) => readField(field, types)) : readField(filled.at(-1), types);
  }

  function put(body, name, value) {
    const path = name.split("."), last = path.pop();
    path.reduce((part, key) => (part[key] ??= {}), body)[last] = value;
  }

  function read(form, button) {
    const sent = { body: {}, query: new URLSearchParams(), values: {}, file: null, password: null, errors: [] }, groups = new Map();
    const ticked = (field) => !["radio", "checkbox"].includes(field.type) || field.checked || field.dataset.type === "flag";
    const fields = [...form.elements].filter((field) => field.name && !field.disabled && field.tagName !== "BUTTON" && ticked(field));
    for (const field of button?.name ? [...fields, button] : fields) {
      if (field.type === "file") sent.file = field;
      else if (field.dataset.confirm !== undefined) sent.password = field.value;
      else groups.set(field.name, [...(groups.get(field.name) || []), field]);
    }
    const same = (field) => field.type !== "hidden" && field.value === field.defaultValue;
    for (const [name, group] of groups) {
      const query = group[0].dataset.query !== undefined;
      if (form.dataset.changed !== undefined && !query && group.every(same)) continue;
      try {
        const value = sent.values[name] = readFields(group);
        if (value === undefined) continue;
        if (query) sent.query.append(name, value); else put(sent.body, name, value);
      } catch (error) { sent.errors.push(error); }
    }
    return sent;
  }

  // ---- calling -----------------------------------------------------------------------------------------------------

  async function request(call, { body = {}, file, version, token } = {}) {
    const [method, path] = call.split(" "), url = new URL(path, location.href);
    const headers = { Accept: "application/json", "X-CSRF-Token": document.querySelector("meta[name=csrf]").content };
    if (file) for (const [name, value] of Object.entries(body)) url.searchParams.append(name, value);
    if (!file && method !== "DELETE") headers["Content-Type"] = "application/json";
    if (version) headers["If-Match"] = `"${version}"`;
    if (token) url.searchParams.set("confirm", token);
    const answer = await fetch(url, {
      method, headers, cache: "no-store", signal: AbortSignal.timeout(file ? UPLOAD_TIMEOUT_MS : TIMEOUT_MS),
      body: method === "DELETE" ? undefined : file || JSON.stringify(body),
    });
    const json = answer.status !== 204 && /json/.test(answer.headers.get("content-type")) ? await answer.json() : null;
    const [etag, to] = ["etag", "location"].map((name) => answer.headers.get(name) || "");
    return { ok: answer.ok, status: answer.status, etag: etag.replace(/^W\/|"/g, ""), location: to, body: json };
  }

  async function send(form, button, more = {}) {
    const given = { ...form.dataset, ...button?.dataset }, sent = more.sent || read(form, button);
    if (form.ariaBusy === "true") return; // pressed twice: sent once
    clear(form);
    for (const { field, message } of sent.errors) showAtField(field, message);
    if (sent.errors.length) { sent.errors[0].field.focus(); return; }
    let answer = { ok: true };
    form.ariaBusy = "true"; pending += 1;
    try {
      let file = sent.file?.files[0];
      if (sent.file?.dataset.type === "text") { put(sent.body, sent.file.name, await file.text()); file = null; }
      if (sent.password !== null) answer = await request("POST /v1/sessions/confirm", { body: { password: sent.password } });
      if (answer.ok) answer = await request(given.call, { body: sent.body, file, version: more.version || given.ifMatch, token: more.token });
    } catch { answer = null; }
    form.ariaBusy = "false"; pending -= 1;
    if (!answer) showAtTop("Not written: the service does not answer. Press the button again.");
    else if (answer.ok) await lead(form, given, sent, answer);
    else refused(form, given, answer, (again) => send(form, button, { sent, ...again }));
    form.dispatchEvent(new CustomEvent("answered", { bubbles: true, detail: answer }));
  }

  async function lead(form, given, sent, answer) {
    const value = (path) => path.split(".").reduce((part, key) => part?.[key], answer.body) ?? "";
    const job = answer.status === 202 && /\/v1\/jobs\/([^/]+)$/.exec(answer.location);
    if (job) { location.assign("/jobs/" + job[1]); return; }
    if (given.renew) { form.reset(); await renew(given.renew.split(" ")); return; }
    if (given.show) {
      const box = document.getElementById(given.show);
      for (const part of box.querySelectorAll("[data-answer]")) part.textContent = value(part.dataset.answer);
      box.hidden = false; box.focus();
      return;
    }
    if (given.next === undefined) { location.reload(); return; }
    const path = given.next.replace(/\{(answer\.)?([\w.]+)\}/g, (_, of, name) => encodeURIComponent(of ? value(name) : sent.values[name] ?? ""));
    const next = new URL(path, location.href);
    for (const [name, text] of sent.query) next.searchParams.append(name, text);
    const same = next.pathname + next.search === here();
    location.assign(next);
    if (same) location.reload(); // another hash alone loads nothing
  }

  async function renew(ids) { // these elements, as the page has them now
    const answer = await fetch(here(), { cache: "no-store", headers: { Accept: "text/html" } });
    const page = new DOMParser().parseFromString(await answer.text(), "text/html");
    // A refusal that has them will do: the page before a test is refused once it is started, and must not keep the test's own page from opening.
    if (answer.redirected || !(answer.ok || ids.every((id) => page.getElementById(id)))) { location.assign(answer.redirected ? answer.url : here()); return; }
    for (const id of ids) {
      const old = document.getElementById(id), now = page.getElementById(id);
      for (const part of old?.querySelectorAll("details[id][open]") || []) now?.querySelector("#" + part.id)?.setAttribute("open", "");
      if (now) old?.replaceWith(now);
    }
    const last = focused && document.getElementById(focused); // a button that was disabled, or replaced, has lost the focus
    if (last && !last.disabled && ids.some((id) => document.getElementById(id)?.contains(last)) && document.activeElement === document.body) last.focus({ preventScroll: true });
    dispatchEvent(new CustomEvent("renewed", { detail: ids }));
  }

  // ---- what was refused --------------------------------------------------------------------------------------------

  function refused(form, given, answer, again) {
    const problem = answer.body || { title: `The service answered with ${answer.status}.` }, kind = (problem.type || "").split("/").pop();
    if (kind === "unauthorized" && given.call !== "POST /v1/sessions") {
      location.assign("/sign-in?next=" + encodeURIComponent(here()));
    } else if (answer.status === 412 && given.again !== "none") {
      ask(changed(problem, given.again), () => (given.again === "reload" ? location.reload() : again({ version: answer.etag })), true);
    } else if (problem.confirm) {
      ask(problem.confirm, () => again({ token: problem.confirm.token }));
    } else {
      const rest = [];
      for (const { field: name, detail } of problem.errors || []) {
        const words = detail.replace(/^Value error, /, ""), entry = form.elements[name] || form.elements[name.replace(/\.\d+$/, "")];
        const field = entry instanceof RadioNodeList ? entry[entry.length - 1] : entry;
        if (field && field.type !== "hidden") showAtField(field, field.title && /match pattern/.test(words) ? field.title : words);
        else rest.push(name === "body" ? words : `${name}: ${words}`);
      }
      form.querySelector("[aria-invalid]")?.focus();
      showAtTop(problem.title, problem.errors ? rest.join(" ") || "See beside the field." : problem.detail, problem.holder?.test_id);
    }
  }

  function showAtField(field, text) {
    const id = (field.id || field.name) + "-error", help = field.getAttribute("aria-describedby") || "";
    field.ariaInvalid = "true";
    field.setAttribute("aria-describedby", `${help.replace(id, "")} ${id}`.trim());
    field.after(make("p", { id, className: "wrong", textContent: text }));
  }

  function showAtTop(title, detail = "", test = "") {
    const box = make("p", { id: "refused", className: "notice bad", role: "alert" }, make("b", { textContent: title }), detail ? ": " + detail : "");
    if (test) box.append(" ", make("a", { className: "button", href: "/tests/" + test, textContent: "See the running test" }));
    document.getElementById("main").prepend(box);
    box.scrollIntoView({ block: "nearest" });
  }

  function clear(form) {
    for (const box of [...document.querySelectorAll("#refused, #asked"), ...form.querySelectorAll(".wrong")]) box.remove();
    for (const field of form.querySelectorAll("[aria-invalid]")) field.removeAttribute("aria-invalid");
  }

  function changed({ title, detail, changes = [] }, again = "Do it all the same") { // the question of a 412
    const rows = changes.map((each) => ({ what: each.action, before: each.old, now: each.new, who: [each.who, new Date(each.at_utc).toLocaleTimeString("en-GB")].filter(Boolean).join(", ") }));
    const warnings = ["Nothing was done. Look at what is there now; what you decide then is a new decision.", ...(rows.length ? [] : [detail])];
    return { title, warnings, rows, button: again === "reload" ? "Show it anew" : again };
  }

  // Not modal: that would put the stop button out of reach. `late`: it is read before it can be pressed.
  function ask({ title, warnings = [], rows = [], button = "Yes" }, yes, late = false) {
    const box = make("dialog", { id: "asked", className: "card question" }, make("h2", { id: "asked-title", textContent: title }));
    const go = make("button", { type: "button", className: "big primary", textContent: button, disabled: late, onclick: () => { box.remove(); yes(); } });
    const no = make("button", { type: "button", className: "big", textContent: "No, go back", onclick: () => box.remove() });
    const columns = { what: "", before: "Before", now: "New", ...(rows.some((row) => row.who) ? { who: "Who and when" } : {}) };
    const line = (tag, row) => make("tr", {}, ...Object.keys(columns).map((name, k) => make(k ? tag : "th", { textContent: row[name] || (row === columns ? "" : "–"), scope: k ? "" : "row" })));
    box.setAttribute("aria-labelledby", "asked-title");
    box.append(...warnings.map((text) => make("p", { className: "notice warn", role: "alert", textContent: text })));
    if (rows.length) box.append(make("table", { className: "asked" }, make("thead", {}, line("th", columns)), make("tbody", {}, ...rows.map((row) => line("td", row)))));
    box.append(make("p", { className: "steps" }, go, " ", no));
    document.getElementById("main").prepend(box);
    box.show();
    no.focus();
    scrollTo(0, 0);
    if (late) setTimeout(() => { go.disabled = false; }, READ_MS);
  }

  document.addEventListener("focusin", (event) => { focused = event.target.id; });
  document.addEventListener("submit", (event) => {
    if (event.target.dataset.call === undefined && event.submitter?.dataset.call === undefined) return;
    event.preventDefault();
    send(event.target, event.submitter);
  });
  return { make, read, renew, request, here, busy: () => pending > 0 };
})();
