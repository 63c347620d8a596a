// A clicked image fills the window until the next click or Escape.
const grown = () => document.querySelector("button.grown");
document.addEventListener("click", event => {
  const chosen = event.target.closest("button.tagged"), previous = grown();
  if (previous) previous.classList.remove("grown");
  if (chosen && chosen !== previous) chosen.classList.add("grown");
});
document.addEventListener("keydown", event => {
  if (event.key === "Escape" && grown()) grown().classList.remove("grown");
});
