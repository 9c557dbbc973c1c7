"""A reset to a new seed, stabilisation included, beside stock robosuite 1.4.1: one JSON line."""

from lerobot_memobench.bench.claims import reset

if __name__ == "__main__":
    print(reset().json())
