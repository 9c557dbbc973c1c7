"""Steps with images per second of 1, 2 and 4 processes and memory of each, beside stock robosuite: JSON lines."""

from lerobot_memobench.bench.workers import workers

if __name__ == "__main__":
    for line in workers():
        print(line.json(), flush=True)
