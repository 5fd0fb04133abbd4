"use strict";
(() => {
  // browsers run no worker of a page that is a file if it is a module made of text, but one whose text is its address
  if (location.protocol === "file:") {
    const Own = window.Worker;
    window.Worker = class extends Own {
      constructor(address, options) {
        const text = new XMLHttpRequest();
        text.open("GET", address, false);
        text.send();
        super("data:text/javascript;charset=utf-8," + encodeURIComponent(text.responseText), options);
      }
    };
  }

  const STEPS = 8; // of a state: without and with photos, without and with boxes, as splats and as points
  const at = (id) => document.getElementById(id);
  const visit = at("visit");
  const marks = at("marks");
  const photos = at("photos");
  const points = at("points");
  const words = document.querySelectorAll("aside .visit");

  // the scene is a recording, a second for each way to show a state; the box with the time goes anywhere in it
  const clock = () => document.querySelector("#root .mantine-NumberInput-input");
  const setValue = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set;
  const wanted = () => STEPS * Number(visit.value) + 4 * points.checked + 2 * marks.checked + 1 * photos.checked + 0.5;

  const show = () => {
    at("number").textContent = visit.value;
    words.forEach((section, number) => (section.hidden = number !== Number(visit.value)));
    const box = clock();
    if (!box) return false;
    setValue.call(box, wanted().toFixed(1));
    box.dispatchEvent(new Event("input", { bubbles: true }));
    return true;
  };

  for (const control of [visit, marks, photos, points]) control.addEventListener("input", show);
  for (const slider of document.querySelectorAll("aside .wipe input")) {
    slider.addEventListener("input", () => slider.parentElement.style.setProperty("--at", slider.value + "%"));
  }
  // a browser that needs longer than this for a picture while somebody drags is given points; who wants splats yet may
  // ask for them, and keeps them
  const SLOW = 100; // milliseconds
  const LOOK = 1000; // milliseconds, and one picture at least after the first two
  let asked = false;
  points.addEventListener("input", () => (asked = true));
  at("root").addEventListener("pointerdown", () => {
    const times = [];
    const tick = (now) => {
      times.push(now);
      if (times.length < 3 || now - times[1] < LOOK) return requestAnimationFrame(tick);
      if (asked || points.checked || (now - times[1]) / (times.length - 2) <= SLOW) return;
      points.checked = true;
      show();
    };
    requestAnimationFrame(tick);
  });

  const begun = new MutationObserver(() => {
    const box = clock();
    if (!box) return;
    begun.disconnect();
    box.closest(".mantine-Paper-root").style.display = "none"; // the controls here take its place
    show();
  });
  begun.observe(at("root"), { childList: true, subtree: true });
  show();
})();
