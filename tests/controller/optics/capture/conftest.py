"""Real photographs are used where VELATURA_DATA says where they lie; nothing else here depends on them."""

from __future__ import annotations

import os
from pathlib import Path

collect_ignore = [] if "VELATURA_DATA" in os.environ else ["test_real_series.py"]
if not Path(os.environ.get("VELATURA_DATA", "."), "memorial").is_dir():
    collect_ignore.append("jpeg/test_real_film.py")
