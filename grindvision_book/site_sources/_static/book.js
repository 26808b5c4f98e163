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
      large.classList.toggle("dark", Boolean(picture.dataset.dark));
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
      frame.className = `scene ${link.dataset.kind}`;
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

// A table that is wider than its column, or whose many columns are so narrow that a row takes more than four lines, is
// set in small type; where that is not enough, or on a telephone, it is shown row by row, every cell with its heading.
function stackWideTables() {
  const tables = [...document.querySelectorAll(".bd-article table")].filter((table) => {
    const heads = [...table.querySelectorAll("thead tr:last-child th")].map((head) => head.textContent.trim());
    for (const row of table.tBodies[0]?.rows ?? []) {
      [...row.cells].forEach((cell, i) => (cell.dataset.heading = heads[i] ?? ""));
    }
    return heads.length > 2 && !table.matches(".evidence");
  });
  const arrange = () => {
    for (const table of tables) {
      table.classList.remove("stacked", "dense");
      const box = table.parentElement;
      const tooWide = () => table.scrollWidth > box.clientWidth + 1 && box.clientWidth > 0;
      const rows = [...(table.tBodies[0]?.rows ?? [])];
      const crowded = rows.some((row) => row.cells.length > 6 && row.offsetHeight > 110);
      if ((tooWide() || crowded) && box.clientWidth > 600) table.classList.add("dense");
      if (tooWide()) {
        table.classList.remove("dense");
        table.classList.add("stacked");
      }
    }
  };
  arrange();
  window.addEventListener("resize", arrange);
  for (const fold of document.querySelectorAll("details")) fold.addEventListener("toggle", arrange);
}

// The evidence's rows by class, chapter and verdict; the choice stands in the address, so that it can be sent to someone.
function filterEvidence() {
  const choices = [...document.querySelectorAll("select[data-filter]")];
  if (!choices.length) return;
  const asked = new URLSearchParams(location.hash.slice(1));
  for (const choice of choices) choice.value = asked.get(choice.dataset.filter) ?? "";
  const rows = [...document.querySelectorAll("table.evidence tbody tr")];
  const show = () => {
    for (const row of rows) {
      row.hidden = choices.some((choice) => choice.value && row.dataset[choice.dataset.filter] !== choice.value);
    }
    const shown = rows.filter((row) => !row.hidden).length;
    document.querySelector(".filters .shown").textContent = `${shown} of ${rows.length} numbers`;
    const set = choices.filter((choice) => choice.value).map((choice) => [choice.dataset.filter, choice.value]);
    history.replaceState(null, "", set.length ? `#${new URLSearchParams(set)}` : location.pathname);
  };
  for (const choice of choices) choice.addEventListener("change", show);
  show();
}

// A formula that is too wide is set smaller, down to six tenths; below that it scrolls.
function fitFormulas() {
  const fit = () => {
    for (const formula of document.querySelectorAll('mjx-container[display="true"]')) {
      formula.style.fontSize = "";
      const part = formula.clientWidth / formula.scrollWidth;
      if (part > 0 && part < 1) formula.style.fontSize = `${100 * Math.max(0.98 * part, 0.6)}%`;
    }
  };
  window.MathJax?.startup?.promise?.then(fit);
  window.addEventListener("resize", fit);
}

// A slider of the page shows one of the finished pictures below it.
function moveFrames() {
  for (const box of document.querySelectorAll(".frames")) {
    const frames = [...box.querySelectorAll("span[data-value]")];
    box.querySelector("input").addEventListener("input", (event) => {
      frames.forEach((frame, at) => (frame.hidden = at !== Number(event.target.value)));
      box.querySelector("output").textContent = frames[event.target.value].dataset.value;
    });
  }
}

// Figures have a dark copy, shown while the page is dark.
function followTheme() {
  const pictures = [...document.querySelectorAll("img[data-dark]")];
  for (const picture of pictures) picture.dataset.light = picture.getAttribute("src");
  const show = () => {
    const wanted = document.documentElement.dataset.theme === "dark" ? "dark" : "light";
    for (const picture of pictures) picture.src = picture.dataset[wanted];
  };
  show();
  new MutationObserver(show).observe(document.documentElement, { attributes: true, attributeFilter: ["data-theme"] });
}

document.addEventListener("DOMContentLoaded", () => {
  followTheme();
  enlargePictures();
  openScenes();
  foldCode();
  stackWideTables();
  filterEvidence();
  moveFrames();
});
window.addEventListener("load", fitFormulas);
