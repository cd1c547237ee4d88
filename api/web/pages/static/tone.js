// A short tone on wish: one at each new segment, three rising ones at the end. Off until somebody ticks the box.
"use strict";
const tone = (() => {
  const KEPT = "stimrig-tone", box = document.getElementById("tone"), hint = document.getElementById("mute");
  let sound = null;

  function wake() { // a browser lets a page sound only after somebody has pressed something on it
    if (!box.checked) { hint.hidden = true; return; }
    sound = sound || new AudioContext();
    sound.resume().then(() => { hint.hidden = true; });
    hint.hidden = sound.state === "running";
  }

  function beep(pitch_hz, after_s) {
    if (!box.checked || !sound || sound.state !== "running") return;
    const voice = sound.createOscillator(), loud = sound.createGain(), start_s = sound.currentTime + after_s;
    voice.frequency.value = pitch_hz;
    loud.gain.setValueAtTime(0, start_s);
    loud.gain.linearRampToValueAtTime(0.2, start_s + 0.01);
    loud.gain.linearRampToValueAtTime(0, start_s + 0.16);
    voice.connect(loud).connect(sound.destination);
    voice.start(start_s); voice.stop(start_s + 0.18);
  }

  try { box.checked = localStorage.getItem(KEPT) === "on"; } catch { /* not kept here */ }
  box.addEventListener("change", () => {
    try { localStorage.setItem(KEPT, box.checked ? "on" : "off"); } catch { /* not kept here */ }
    wake();
    beep(660, 0);
  });
  for (const kind of ["pointerdown", "keydown"]) addEventListener(kind, wake);
  wake();
  return { segment: () => beep(660, 0), end: () => [523, 659, 784].forEach((pitch, k) => beep(pitch, 0.2 * k)) };
})();
