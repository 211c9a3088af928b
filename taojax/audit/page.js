// A number in a table tells what its column means.
document.addEventListener("mouseover", (event) => {
  const found = event.target.closest && event.target.closest("td");
  if (!found || found.title || found.querySelector("abbr")) return;
  const head = found.closest("table").querySelectorAll("th")[found.cellIndex];
  const word = head && head.querySelector("abbr");
  if (word) found.title = `${word.textContent}: ${word.title}`;
});

// A link into a fold opens it; #frame=N leads to the frames. On paper everything is open.
const folds = [...document.querySelectorAll("details")];
const unfold = () => {
  const isFrame = location.hash.startsWith("#frame="), name = isFrame ? "along" : location.hash.slice(1);
  const found = name && document.getElementById(name), fold = found && found.closest("details");
  if (!fold) return;
  fold.open = true;
  if (isFrame) fold.scrollIntoView();
};
let shut = [];
window.addEventListener("hashchange", unfold);
window.addEventListener("beforeprint", () => {
  shut = folds.filter((fold) => !fold.open);
  shut.forEach((fold) => { fold.open = true; });
});
window.addEventListener("afterprint", () => shut.forEach((fold) => { fold.open = false; }));
unfold();
