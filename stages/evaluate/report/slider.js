"use strict";
(function () {
  var slider = document.getElementById("frame");
  if (!slider) return;
  var frames = Array.prototype.slice.call(document.querySelectorAll(".slide"));
  var said = document.getElementById("frame-said");
  function show() {
    var place = Number(slider.value);
    frames.forEach(function (one, index) { one.hidden = index !== place; });
    said.textContent = frames[place].dataset.said;
  }
  slider.max = String(frames.length - 1);
  slider.addEventListener("input", show);
  document.querySelectorAll("[data-step]").forEach(function (button) {
    button.addEventListener("click", function () {
      var next = Number(slider.value) + Number(button.dataset.step);
      slider.value = String((next + frames.length) % frames.length);
      show();
    });
  });
  document.getElementById("frame-controls").hidden = false;
  show();
})();
