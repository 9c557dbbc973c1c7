"""A control step with both 256×256 images, beside stock robosuite 1.4.1: one JSON line."""

from lerobot_memobench.bench.claims import step_with_images

if __name__ == "__main__":
    print(step_with_images().json())
