"""Without viser, no test of the live view."""

import importlib.util

collect_ignore_glob = [] if importlib.util.find_spec("viser") else ["test_*.py"]
