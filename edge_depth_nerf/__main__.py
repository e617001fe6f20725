"""`python -m edge_depth_nerf WORDS`: our command; with --end-with-parent first, it ends when its starter is gone."""

from __future__ import annotations

import sys

from edge_depth_nerf.entry import main

if __name__ == "__main__":
    if sys.argv[1:2] == ["--end-with-parent"]:
        del sys.argv[1]
        from edge_depth_nerf.jobs.runs import end_with_parent

        end_with_parent()
    main()
