document.querySelectorAll("table").forEach(table => {
  const body = table.tBodies[0], rows = [...body.rows];
  if (rows.length < 2) return;
  [...table.tHead.rows[0].cells].forEach((head, k) => {
    const text = row => row.cells[k].textContent.trim(), value = row => parseFloat(text(row));
    let up = false;
    head.classList.add("sortable");
    head.title = "sort";
    head.addEventListener("click", () => {
      up = !up;
      const words = rows.every(row => isNaN(value(row)));
      const order = (a, b) => words ? text(a).localeCompare(text(b))
        : isNaN(value(a)) ? 1 : isNaN(value(b)) ? -1 : value(a) - value(b);
      [...rows].sort((a, b) => up || (!words && (isNaN(value(a)) || isNaN(value(b)))) ? order(a, b) : order(b, a))
        .forEach(row => body.append(row));
    });
  });
  if (rows.length < 6) return;
  const field = document.createElement("input");
  field.placeholder = "filter";
  field.setAttribute("aria-label", "filter the rows of this table");
  field.addEventListener("input", () => {
    const words = field.value.toLowerCase().split(" ");
    rows.forEach(row => row.hidden = !words.every(word => row.textContent.toLowerCase().includes(word)));
  });
  table.parentElement.before(field);
});
