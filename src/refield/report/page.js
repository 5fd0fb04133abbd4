"use strict";
(() => {
  const make = (tag, settings) => Object.assign(document.createElement(tag), settings);
  const close = make("button", { type: "button", className: "close", textContent: "Close" });
  const dialog = make("dialog", { className: "large" });
  let back = null; // what puts the enlarged figure back
  dialog.append(close);
  document.body.append(dialog);
  close.addEventListener("click", () => dialog.close());
  dialog.addEventListener("click", (event) => event.target === dialog && dialog.close());
  dialog.addEventListener("close", () => back && back());

  const enlarge = (figure, button) => {
    const place = document.createComment("");
    figure.replaceWith(place);
    dialog.append(figure);
    dialog.setAttribute("aria-label", figure.dataset.name);
    back = () => {
      place.replaceWith(figure);
      back = null;
      button.focus();
    };
    dialog.showModal();
  };

  for (const figure of document.querySelectorAll("figure[data-name]")) {
    const stage = figure.querySelector(".stage");
    if (figure.classList.contains("pair")) {
      const wipe = make("input", { type: "range", min: 0, max: 100, value: 50 });
      wipe.setAttribute("aria-label", "How much is shown as before: " + figure.dataset.name);
      wipe.addEventListener("input", () => figure.style.setProperty("--at", wipe.value + "%"));
      stage.append(wipe);
      figure.classList.add("slide");
    }
    const button = make("button", { type: "button", className: "enlarge", textContent: "Enlarge" });
    button.setAttribute("aria-label", "Enlarge " + figure.dataset.name);
    button.addEventListener("click", () => enlarge(figure, button));
    figure.querySelector("figcaption").append(button);
    if (figure.classList.contains("photo")) {
      stage.addEventListener("click", () => back || enlarge(figure, button));
    }
  }
})();
