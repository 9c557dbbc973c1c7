"""A control step without images, beside stock robosuite 1.4.1: one JSON line."""

from lerobot_memobench.bench.claims import step_without_images

if __name__ == "__main__":
    print(step_without_images().json())
