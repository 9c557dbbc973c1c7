"""Steps and resets through LeRobot's vector environment, both images, beside stock robosuite 1.4.1: JSON lines."""

from lerobot_memobench.bench.claims import vector_env

if __name__ == "__main__":
    for line in vector_env():
        print(line.json(), flush=True)
