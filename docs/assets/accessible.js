// The theme builds these in the browser: the bar of each code block gets a name of its own, and what
// scrolls can be reached by keyboard.
new MutationObserver(() => {
  document.querySelectorAll("nav.md-code__nav").forEach((bar, i) => {
    if (!bar.hasAttribute("aria-label")) bar.setAttribute("aria-label", `Code ${i + 1}`);
  });
  const scrolling = '.md-typeset__scrollwrap, .output, mjx-container[display="true"]';
  for (const box of document.querySelectorAll(scrolling)) {
    if (!box.hasAttribute("tabindex")) box.setAttribute("tabindex", "0");
  }
}).observe(document, { childList: true, subtree: true });
