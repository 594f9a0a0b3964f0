import sys
from pathlib import Path

# The demo is a folder of scripts, not a package.
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
