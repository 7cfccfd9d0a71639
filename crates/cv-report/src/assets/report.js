// A click on an image enlarges it to the window; a second click shows it at its own size; Escape or a click beside it closes it.
(() => {
  const box = document.createElement("dialog");
  const big = document.createElement("img");
  box.setAttribute("aria-label", "Image");
  box.append(big);
  document.body.append(box);
  document.querySelectorAll("figure img").forEach((img) => {
    img.tabIndex = 0;
    const open = () => {
      big.src = img.src;
      big.alt = img.alt;
      box.classList.remove("full");
      box.showModal();
    };
    img.addEventListener("click", open);
    img.addEventListener("keydown", (e) => e.key === "Enter" && open());
  });
  box.addEventListener("click", (e) => {
    const fits = big.naturalWidth <= big.clientWidth;
    if (e.target === big && !fits && !box.classList.contains("full")) box.classList.add("full");
    else box.close();
  });
})();
