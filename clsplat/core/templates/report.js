// A clicked image fills the window until the next click or Escape.
const grown = () => document.querySelector("button.grown");
document.addEventListener("click", event => {
  const chosen = event.target.closest("button.tagged"), before = grown();
  if (before) before.classList.remove("grown");
  if (chosen && chosen !== before) chosen.classList.add("grown");
});
document.addEventListener("keydown", event => {
  if (event.key === "Escape" && grown()) grown().classList.remove("grown");
});
