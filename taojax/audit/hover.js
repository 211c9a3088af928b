// A number in a table tells what its column means.
document.addEventListener("mouseover", (event) => {
  const found = event.target.closest && event.target.closest("td");
  if (!found || found.title || found.querySelector("abbr")) return;
  const head = found.closest("table").querySelectorAll("th")[found.cellIndex];
  const word = head && head.querySelector("abbr");
  if (word) found.title = `${word.textContent}: ${word.title}`;
});
