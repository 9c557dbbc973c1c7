"""Makes the job of these tests importable in other processes."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))  # for note_job.py: pytest imports tests by their paths
