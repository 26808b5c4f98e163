// Makes the pages fit the paper, and says where they do not; called from pdf.py once formulas and pictures are there.
"use strict";

const SMALLEST_TABLE = 0.72; // of the size of a table's text; a table that is wider still gets a page across
const SMALLEST_FORMULA = 0.6;

const shrinkToFit = (element, place, smallest) => {
  element.style.fontSize = "";
  const size = parseFloat(getComputedStyle(element).fontSize);
  for (let part = 1; part >= smallest - 1e-9; part -= 0.04) {
    element.style.fontSize = `${size * part}px`;
    if (element.scrollWidth <= place + 1 && element.getBoundingClientRect().width <= place + 1) return true;
  }
  return false;
};

window.fitToPaper = (paperWidth, acrossWidth) => {
  for (const formula of document.querySelectorAll('mjx-container[display="true"]')) {
    const drawn = formula.querySelector("svg");
    const place = formula.parentElement.clientWidth;
    const part = drawn ? place / drawn.getBoundingClientRect().width : 1;
    if (part < 1) formula.style.fontSize = `${100 * Math.max(0.98 * part, SMALLEST_FORMULA)}%`;
  }
  for (const table of document.querySelectorAll(".bd-article table")) {
    if (!shrinkToFit(table, table.parentElement.clientWidth, SMALLEST_TABLE)) {
      table.classList.add("landscape");
      table.style.width = `${acrossWidth}px`;
      shrinkToFit(table, acrossWidth, 0.6);
    }
  }
};

// Boxes that reach beyond the paper's text, as texts.
window.boxesBeyondThePaper = (paperWidth, acrossWidth) =>
  [...document.querySelectorAll(".bd-article :is(pre, table, img, figure, p, mjx-container > svg)")]
    .filter((box) => {
      const place = box.closest(".landscape") ? acrossWidth : paperWidth;
      const edges = box.getBoundingClientRect();
      return edges.right > place + 1 || edges.left < -1 || (box.matches("pre") && box.scrollWidth > box.clientWidth + 1);
    })
    .map((box) => `${box.closest("section.page").id}: ${box.tagName} ${Math.round(box.getBoundingClientRect().right)}`);
