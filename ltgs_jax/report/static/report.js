"use strict";

// Before/after: drag anywhere on a photograph, or the arrow keys on its hidden range.
for (const shot of document.querySelectorAll(".shot")) {
  const frame = shot.querySelector(".frame");
  const range = frame.querySelector("input");
  const cut = (percent) => {
    range.value = Math.min(100, Math.max(0, percent));
    frame.style.setProperty("--cut", range.value + "%");
  };
  const follow = (event) => {
    const box = frame.getBoundingClientRect();
    cut((100 * (event.clientX - box.left)) / box.width);
  };
  range.addEventListener("input", () => cut(range.value));
  frame.addEventListener("pointerdown", (event) => {
    frame.setPointerCapture(event.pointerId);
    follow(event);
  });
  frame.addEventListener("pointermove", (event) => {
    if (event.buttons) follow(event);
  });
  const show = (button) => {
    const [below, above] = button.dataset.show.split(" ");
    for (const image of frame.querySelectorAll("img")) {
      image.classList.toggle("below", image.dataset.layer === below);
      image.classList.toggle("above", image.dataset.layer === above);
    }
    frame.classList.toggle("single", !above);
    frame.querySelector(".left").textContent = button.dataset.left;
    frame.querySelector(".right").textContent = button.dataset.right || "";
    for (const other of shot.querySelectorAll("[data-show]")) other.setAttribute("aria-pressed", other === button);
  };
  for (const button of shot.querySelectorAll("[data-show]")) button.addEventListener("click", () => show(button));
  const outlines = shot.querySelector("[data-outline]");
  if (outlines) {
    outlines.addEventListener("click", () => {
      outlines.setAttribute("aria-pressed", frame.classList.toggle("outlined"));
    });
  }
}

// Tables sort by the column whose head is clicked; numbers by their value, the rest as text.
for (const table of document.querySelectorAll("table[data-sortable]")) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    head.tabIndex = 0;
    const sort = () => {
      const descending = head.getAttribute("aria-sort") === "ascending";
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", descending ? "descending" : "ascending");
      const key = (row) => row.cells[column].dataset.value ?? row.cells[column].textContent;
      const compare = (a, b) => {
        const [x, y] = [key(a), key(b)];
        if (x === "" || y === "") return (x === "") - (y === ""); // what is missing comes last, either way
        const order = isNaN(x) || isNaN(y) ? x.localeCompare(y, undefined, { numeric: true }) : x - y;
        return descending ? -order : order;
      };
      const rows = [...table.tBodies[0].rows].sort(compare);
      table.tBodies[0].append(...rows);
    };
    head.addEventListener("click", sort);
    head.addEventListener("keydown", (event) => {
      if (event.key === "Enter") sort();
    });
  });
}
