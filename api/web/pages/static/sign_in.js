// A link printed by the service may carry the token after '#': that part never leaves the browser.
"use strict";
function takeToken() {
  const token = new URLSearchParams(location.hash.slice(1)).get("token");
  if (!token) return;
  document.getElementById("by-token").open = true;
  document.getElementById("token").value = token;
  history.replaceState(null, "", location.pathname + location.search);
}
addEventListener("hashchange", takeToken);
takeToken();
