document.addEventListener("input", event => {
  const crop = event.target.closest(".crop");
  crop.style.setProperty("--cut", event.target.value + "%");
  for (const slider of crop.querySelectorAll("input")) slider.value = event.target.value;
});
