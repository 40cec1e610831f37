"""Real photographs are used where VELATURA_DATA says where they lie; nothing here depends on them."""

from __future__ import annotations

import os

collect_ignore = [] if "VELATURA_DATA" in os.environ else ["test_real_brackets.py"]
