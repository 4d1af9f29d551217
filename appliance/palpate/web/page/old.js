/* For browsers that do not understand the page's modules: written so that they understand it. */

window.onload = function () {
  var banner = document.getElementById("banner");
  if (!banner || document.documentElement.getAttribute("data-runs")) return;
  banner.removeAttribute("hidden");
  banner.textContent = "This browser is too old for this page: use Chromium 83, Firefox 78 or Safari 14, or a later one.";
};
