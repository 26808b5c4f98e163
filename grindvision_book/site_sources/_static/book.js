// What the pages do besides being read: enlarge a picture, open a 3D scene in place, hide or show the code.
"use strict";

// A click on a picture of the text enlarges it; Escape or a second click puts it back.
function enlargePictures() {
  const dialog = document.createElement("dialog");
  dialog.className = "enlarged";
  dialog.setAttribute("aria-label", "Enlarged picture");
  document.body.append(dialog);
  dialog.addEventListener("click", () => dialog.close());
  dialog.addEventListener("keydown", (event) => {
    if (event.key === "Escape") dialog.close(); // the theme keeps this key for its search
  });
  for (const picture of document.querySelectorAll(".bd-article img")) {
    if (picture.closest("a, button")) continue;
    const button = document.createElement("button");
    button.type = "button";
    button.className = "picture";
    button.setAttribute("aria-label", "Enlarge: " + picture.alt);
    picture.replaceWith(button);
    button.append(picture);
    button.addEventListener("click", () => {
      const large = new Image();
      large.src = picture.dataset.full || picture.src;
      large.alt = picture.alt;
      dialog.replaceChildren(large);
      dialog.showModal();
    });
  }
}

// A link to a scene opens it below itself; the link then closes it again, which also frees its memory.
function openScenes() {
  for (const link of document.querySelectorAll("a.scene")) {
    const invitation = link.textContent;
    link.setAttribute("role", "button");
    link.addEventListener("click", (event) => {
      event.preventDefault();
      const open = link.parentElement.querySelector("iframe");
      if (open) {
        open.remove();
        link.textContent = invitation;
        return;
      }
      const frame = document.createElement("iframe");
      frame.className = "scene";
      frame.title = link.dataset.title;
      frame.src = link.href;
      link.after(frame);
      link.textContent = "Close the 3D scene (drag to turn, Shift to shift, wheel to zoom)";
    });
  }
}

// One button for all code of a chapter.
function foldCode() {
  const title = document.querySelector(".bd-article h1");
  if (!title || !document.querySelector(".cell_input")) return;
  const button = document.createElement("button");
  button.type = "button";
  button.className = "fold-code";
  const show = (shown) => {
    document.body.classList.toggle("without-code", !shown);
    button.textContent = shown ? "Hide all code" : "Show all code";
    button.setAttribute("aria-pressed", String(!shown));
    for (const fold of document.querySelectorAll("details.hide")) if (!shown) fold.open = false;
  };
  button.addEventListener("click", () => show(document.body.classList.contains("without-code")));
  show(true);
  title.after(button);
}

document.addEventListener("DOMContentLoaded", () => {
  enlargePictures();
  openScenes();
  foldCode();
});
