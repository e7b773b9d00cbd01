// TeX between \( \) and \[ \], as pymdownx.arithmatex writes it; nothing else on a page is touched.
window.MathJax = {
  tex: { inlineMath: [["\\(", "\\)"]], displayMath: [["\\[", "\\]"]], processEscapes: true },
  options: { ignoreHtmlClass: ".*|", processHtmlClass: "arithmatex", enableMenu: false },
  svg: { fontCache: "local", scale: 0.9 },
};
