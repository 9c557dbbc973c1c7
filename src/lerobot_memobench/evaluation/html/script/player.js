// The video of a rollout. Frame k is on the screen from k / fps to (k + 1) / fps.

/** The video with its buttons, or a plain word where there is none. `moved` is told the frame that is seen. */
function stage(episode, moved) {
  if (!episode.video) return emptyStage();
  const video = el("video", {
    preload: "auto",
    playsinline: true,
    "aria-label": `Video of episode ${episode.episode}`,
  });
  video.muted = true;
  const play = el("button", { type: "button", class: "play", "aria-label": "Play" }, "▶");
  const speed = el(
    "select",
    { "aria-label": "Speed" },
    [0.5, 1, 2, 4].map((rate) => el("option", { value: rate }, `${rate}×`)),
  );
  const error = el("p", { class: "notice", hidden: true });
  const root = el(
    "div",
    { class: "stage" },
    el("div", { class: "screen" }, video),
    error,
    el(
      "div",
      { class: "buttons" },
      play,
      speed,
      el("span", { class: "hint" }, "Space plays, ← → step, [ ] jump between checkpoints"),
    ),
  );

  const seen = () => Math.floor(video.currentTime * DATA.fps + 1e-3);
  const follow = () => {
    if (!root.isConnected) return video.pause();
    moved(seen());
    if (!video.paused && !video.ended) requestAnimationFrame(follow);
  };
  const toggle = () => (video.paused ? video.play().catch(() => {}) : video.pause());
  const label = () => {
    play.textContent = video.paused ? "▶" : "❚❚";
    play.setAttribute("aria-label", video.paused ? "Play" : "Pause");
  };
  video.addEventListener("play", () => (label(), follow()));
  video.addEventListener("pause", label);
  video.addEventListener("ended", label);
  video.addEventListener("seeked", () => root.isConnected && moved(seen()));
  video.addEventListener("click", toggle);
  video.addEventListener("error", () => {
    const reason = video.error?.message || "the file is missing or not supported";
    error.hidden = false;
    error.textContent = `This browser cannot play ${episode.video} (H.264 in MP4): ${reason}.`;
  });
  play.addEventListener("click", toggle);
  speed.value = String(stage.speed ?? 1);
  const setSpeed = () => {
    stage.speed = Number(speed.value);
    video.defaultPlaybackRate = video.playbackRate = stage.speed;
  };
  speed.addEventListener("change", setSpeed);
  setSpeed();
  video.src = episode.video.split("/").map(encodeURIComponent).join("/");
  // Into the middle of the frame, so that rounding cannot show the one before.
  const seek = (frame) => (video.currentTime = (frame + 0.5) / DATA.fps);
  return { root, seek, toggle, stop: () => video.pause() };
}

function emptyStage() {
  const word = el("p", { role: "status" }, "There is no video of this episode.");
  const hint = "The timeline below is from the log. Evaluate with videos=-1 to record every episode.";
  const ask = () => word.classList.add("asked");
  return {
    root: el("div", { class: "stage absent" }, word, el("p", { class: "hint" }, hint)),
    seek: ask,
    toggle: ask,
    stop: () => {},
  };
}
