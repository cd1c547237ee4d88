// Forms that call REST: `<form data-call="PUT /v1/...">`. Fields become JSON; the answer leads on, or is shown where it belongs.
// Attributes of a form, or of the pressed button, which goes before:
//   data-call      method and address; {name} in it is a field's value
//   data-if-match  version that the page shows
//   data-next      address to go to; {name} is a field's value, {answer.id} a value of the answer. Without it the page loads again.
//   data-renew     ids of elements to take from the page anew, instead of loading it
//   data-show      id of a hidden element that shows the answer: its [data-answer=key] get the text of that key
//   data-changed   send only the fields that a person has changed
// Attributes of a field:
//   data-type      number, int, degrees (sent in radians), flag, list; "number list": all fields of this name as one list
//   data-empty     "null": an empty field is sent as null. Otherwise it is left out.
//   data-query     goes into the query of data-next instead of the body
//   data-confirm   a password, sent to POST /v1/sessions/confirm first
// Dots in a name nest. The file of a file field is the body; the other fields then go into the query.
"use strict";
const act = (() => {
  const PATIENCE_MS = 30000, FILE_PATIENCE_MS = 600000, READ_MS = 2000;
  const words = JSON.parse(document.getElementById("rig-words").textContent);
  const NUMBER = /^[-−]?(?:0|[1-9]\d{0,4})(?:[.,]\d{1,2})?$/, WHOLE = /^(?:0|[1-9]\d{0,4})$/;
  const here = () => location.pathname + location.search;
  const make = (tag, given = {}, ...children) => { const box = Object.assign(document.createElement(tag), given); box.append(...children); return box; };
  let pending = 0;

  // ---- reading a form ----------------------------------------------------------------------------------------------

  function readText(field, types) {
    const text = field.value.trim();
    if (types.includes("flag")) return field.type === "checkbox" ? field.checked : ["1", "true", "on"].includes(text);
    if (types.includes("int") && WHOLE.test(text)) return Number(text);
    if (types.includes("int")) throw new Error(words.no_whole.replace("{text}", text));
    if (!types.includes("number") && !types.includes("degrees")) return text;
    const own = text === field.defaultValue && text && Number.isFinite(Number(text)); // as the page wrote it, however fine
    if (!own && !NUMBER.test(text)) throw new Error(words.no_number.replace("{text}", text));
    const value = Number(text.replace("−", "-").replace(",", "."));
    return types.includes("degrees") ? (value * Math.PI) / 180 : value;
  }

  function readGroup(fields) { // all fields of one name; undefined: nothing to send
    const first = fields[0], types = (first.dataset.type || "").split(" "), filled = fields.filter((field) => field.value.trim());
    if (types.includes("flag")) return readText(fields[fields.length - 1], types);
    if (!filled.length) return first.dataset.empty === "null" ? null : undefined;
    if (!types.includes("list")) return attempt(filled[filled.length - 1], types);
    if (types.length > 1) return fields.map((field) => attempt(field, types));
    return filled.flatMap((field) => field.value.split(/[\s,]+/)).filter(Boolean);
  }

  function attempt(field, types) {
    try { return readText(field, types); } catch (error) { throw Object.assign(error, { field }); }
  }

  function put(body, name, value) {
    const path = name.split("."), last = path.pop();
    path.reduce((part, key) => (part[key] ??= {}), body)[last] = value;
  }

  function read(form, button) {
    const groups = new Map(), sent = { body: {}, query: new URLSearchParams(), values: {}, file: null, password: null, errors: [] };
    const isSent = (field) => field.name && !field.disabled && !["BUTTON", "FIELDSET"].includes(field.tagName)
      && (!["radio", "checkbox"].includes(field.type) || field.checked || (field.type === "checkbox" && field.dataset.type === "flag"));
    for (const field of [...form.elements].filter(isSent).concat(button?.name ? [button] : [])) {
      if (field.type === "file") sent.file = field.files[0] || null;
      else if (field.dataset.confirm !== undefined) sent.password = field.value;
      else groups.set(field.name, [...(groups.get(field.name) || []), field]);
    }
    for (const [name, fields] of groups) {
      const typed = fields.filter((field) => field.type !== "hidden" && field !== button);
      if (form.dataset.changed !== undefined && typed.length && typed.every((field) => field.value === field.defaultValue) && fields[0].dataset.query === undefined) continue;
      try {
        const value = readGroup(fields);
        sent.values[name] = value;
        if (value === undefined) continue;
        if (fields[0].dataset.query !== undefined) sent.query.append(name, value);
        else put(sent.body, name, value);
      } catch (error) { sent.errors.push(error); }
    }
    return sent;
  }

  // ---- calling -----------------------------------------------------------------------------------------------------

  async function request(call, { body, file, version, token } = {}) {
    const [method, address] = call.split(" "), at = new URL(address, location.href), ending = new AbortController();
    const headers = { Accept: "application/json", "X-CSRF-Token": document.querySelector("meta[name=csrf]").content };
    if (file) for (const [name, value] of Object.entries(body)) at.searchParams.append(name, value);
    else if (method !== "DELETE") headers["Content-Type"] = "application/json";
    if (version) headers["If-Match"] = `"${version}"`;
    if (token) at.searchParams.set("confirm", token);
    const timer = setTimeout(() => ending.abort(), file ? FILE_PATIENCE_MS : PATIENCE_MS);
    try {
      const answer = await fetch(at, { method, headers, cache: "no-store", signal: ending.signal, body: method === "DELETE" ? undefined : file || JSON.stringify(body) });
      const json = /json/.test(answer.headers.get("content-type") || "");
      return { ok: answer.ok, status: answer.status, etag: (answer.headers.get("etag") || "").replace(/^W\/|"/g, ""), location: answer.headers.get("location"), body: json && answer.status !== 204 ? await answer.json() : null };
    } finally { clearTimeout(timer); }
  }

  async function send(form, button, more = {}) {
    const given = { ...form.dataset, ...(button ? button.dataset : {}) }, sent = more.sent || read(form, button);
    if (form.ariaBusy === "true") return null; // pressed twice: sent once
    clear(form);
    if (sent.errors.length) { sent.errors.forEach((error) => atField(error.field, error.message)); sent.errors[0].field.focus(); return null; }
    const filled = (text) => text.replace(/\{([\w.]+)\}/g, (_, name) => encodeURIComponent(sent.values[name] ?? ""));
    const version = more.version || given.ifMatch;
    form.ariaBusy = "true"; pending += 1;
    let answer = null;
    try {
      if (sent.password !== null) answer = await request("POST /v1/sessions/confirm", { body: { password: sent.password } });
      if (!answer || answer.ok) answer = await request(filled(given.call), { body: sent.body, file: sent.file, version, token: more.token });
    } catch { answer = null; }
    form.ariaBusy = "false"; pending -= 1;
    form.dispatchEvent(new CustomEvent("answered", { bubbles: true, detail: answer }));
    if (!answer) atTop([words.not_written]);
    else if (answer.ok) await lead(given, sent, answer, filled);
    else refused(form, button, sent, answer);
    return answer;
  }

  async function lead(given, sent, answer, filled) {
    const value = (path) => path.split(".").reduce((part, key) => part?.[key], answer.body) ?? "";
    const job = answer.status === 202 && /\/v1\/jobs\/([^/]+)$/.exec(answer.location || "");
    if (job) return location.assign("/jobs/" + job[1]);
    if (given.show) {
      const box = document.getElementById(given.show);
      for (const part of box.querySelectorAll("[data-answer]")) part.textContent = value(part.dataset.answer);
      box.hidden = false; box.focus();
      return null;
    }
    if (given.renew) return renew(given.renew.split(" "));
    if (given.next === undefined) return location.reload();
    const next = new URL(filled(given.next.replace(/\{answer\.([\w.]+)\}/g, (_, path) => encodeURIComponent(value(path)))), location.href);
    for (const [name, text] of sent.query) next.searchParams.append(name, text);
    const same = next.pathname + next.search === here();
    location.assign(next);
    return same ? location.reload() : null; // only the hash is another one: then nothing is loaded
  }

  async function renew(ids, at = here()) { // these elements as the page has them now
    const answer = await fetch(at, { cache: "no-store", headers: { Accept: "text/html" } });
    if (!answer.ok || answer.redirected) return location.assign(answer.redirected ? answer.url : here());
    const page = new DOMParser().parseFromString(await answer.text(), "text/html"), focused = document.activeElement?.id;
    for (const id of ids) {
      const [old, fresh] = [document.getElementById(id), page.getElementById(id)];
      if (old && fresh) old.replaceWith(fresh);
    }
    if (focused && document.activeElement === document.body) document.getElementById(focused)?.focus({ preventScroll: true });
    return dispatchEvent(new CustomEvent("renewed", { detail: ids }));
  }

  // ---- what was refused --------------------------------------------------------------------------------------------

  function refused(form, button, sent, answer) {
    const problem = answer.body || { title: words.not_written, detail: "" }, kind = (problem.type || "").split("/").pop();
    if (kind === "locked" || answer.status === 423) return location.assign("/locked?next=" + encodeURIComponent(here()));
    if (answer.status === 401 && kind !== "wrong-password") return location.assign("/sign-in?next=" + encodeURIComponent(here()));
    const again = (more) => send(form, button, { version: answer.etag || form.dataset.ifMatch, sent, ...more });
    if (answer.status === 412 && answer.etag) return ask(changed(problem, button || form), () => again({}), true);
    if (problem.confirm) return ask(problem.confirm, () => again({ version: (button?.dataset.ifMatch || form.dataset.ifMatch), token: problem.confirm.token }), false);
    const rest = [], errors = problem.errors || [];
    for (const { field: name, detail } of errors) {
      const field = form.elements[name] || form.elements[name.replace(/\.\d+$/, "")], box = field instanceof RadioNodeList ? field[field.length - 1] : field;
      if (box instanceof Element && box.type !== "hidden" && box.tagName !== "BUTTON") atField(box, /match pattern/.test(detail) && box.title ? box.title : detail);
      else rest.push(`${name}: ${detail}`);
    }
    form.querySelector("[aria-invalid]")?.focus();
    const whole = errors.length ? (rest.length ? rest : [words.see_field]) : [problem.detail];
    return atTop([problem.title, ...whole], problem.holder?.test_id ? `/tests/${problem.holder.test_id}` : "");
  }

  function atField(field, text) {
    const id = (field.id || field.name) + "-error";
    field.setAttribute("aria-invalid", "true");
    field.setAttribute("aria-describedby", [...(field.getAttribute("aria-describedby") || "").split(" ").filter((part) => part && part !== id), id].join(" "));
    field.after(make("p", { id, className: "wrong", textContent: text }));
  }

  function atTop([title, ...rest], test = "") {
    const box = make("div", { id: "refused", className: "notice bad" }, make("b", { textContent: title }), " " + rest.join(" "));
    if (test) box.append(" ", make("a", { className: "button", href: test, textContent: words.see_test }));
    box.setAttribute("role", "alert");
    document.getElementById("main").prepend(box);
    box.scrollIntoView({ block: "nearest" });
  }

  function clear(form) {
    for (const box of document.querySelectorAll("#refused, #asked")) box.remove();
    for (const box of form.querySelectorAll(".wrong")) box.remove();
    for (const field of form.querySelectorAll("[aria-invalid]")) field.removeAttribute("aria-invalid");
  }

  const text = (value) => (value === null || value === undefined ? "–" : typeof value !== "object" ? String(value) : Object.entries(value).map(([name, each]) => `${name} ${text(each)}`).join(", "));

  function changed(problem, pressed) {
    const rows = (problem.changes || []).map((each) => ({ what: each.action, now: each.new, before: each.old, who: `${each.who}, ${new Date(each.at_utc).toLocaleTimeString()}` }));
    return { title: problem.title, warnings: [words.changed, ...(rows.length ? [] : [problem.detail])], rows, button: `${(pressed.dataset.again || pressed.textContent.trim())}${pressed.dataset.again ? "" : words.all_the_same}` };
  }

  // Not modal: a modal one would put the stop button out of reach. `late`: read before it can be pressed.
  function ask(question, yes, late) {
    const box = make("dialog", { id: "asked", className: "card question" }), close = () => box.remove();
    const rows = question.rows || [], cell = (name, value) => make(name, { textContent: text(value) });
    const head = ["", words.before, words.now, ...(rows.some((row) => row.who) ? [words.who] : [])];
    const lines = rows.map((row) => make("tr", {}, cell("th", row.what), cell("td", row.before), make("td", {}, cell("b", row.now)), ...(row.who ? [cell("td", row.who)] : [])));
    const go = make("button", { type: "button", className: "big primary", textContent: question.button || words.yes, onclick: () => { close(); yes(); } });
    const no = make("button", { type: "button", className: "big", textContent: words.no, onclick: close });
    box.append(make("h2", { id: "asked-title", textContent: question.title }));
    for (const warning of question.warnings || []) { const line = make("p", { className: "notice warn", textContent: warning }); line.setAttribute("role", "alert"); box.append(line); }
    if (rows.length) box.append(make("table", { className: "asked" }, make("thead", {}, make("tr", {}, ...head.map((name) => cell("th", name)))), make("tbody", {}, ...lines)));
    box.append(make("p", { className: "steps" }, go, " ", no));
    box.setAttribute("aria-labelledby", "asked-title");
    document.getElementById("main").prepend(box);
    box.show();
    no.focus();
    scrollTo(0, 0);
    if (late) { go.disabled = true; setTimeout(() => { go.disabled = false; }, READ_MS); }
  }

  document.addEventListener("submit", (event) => {
    if (event.target.dataset.call === undefined && event.submitter?.dataset.call === undefined) return;
    event.preventDefault();
    send(event.target, event.submitter);
  });

  return { send, renew, request, busy: () => pending > 0 };
})();
