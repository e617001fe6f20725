"""`python -m edge_depth_nerf.child WORDS`: our command, as a process that dies with the one that started it."""

from __future__ import annotations

from edge_depth_nerf.entry import main
from edge_depth_nerf.runs import end_with_parent

if __name__ == "__main__":
    end_with_parent()
    main()
