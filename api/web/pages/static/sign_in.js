// A link printed by the service may carry the token after '#': that part never leaves the browser.
"use strict";
function take() {
  const carried = new URLSearchParams(location.hash.slice(1)).get("token");
  if (!carried) return;
  document.getElementById("by-token").open = true;
  document.getElementById("token").value = carried;
  history.replaceState(null, "", location.pathname + location.search);
}
addEventListener("hashchange", take);
take();
sessionStorage.clear(); // what somebody else had typed before the session ended
