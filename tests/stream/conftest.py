"""Where helpers of other folders lie."""

import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1] / folder) for folder in ("reports", "studio")]
