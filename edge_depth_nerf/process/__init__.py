"""Converters: each reads one kind of recording and writes a scene folder through the one writer in `scene`.

`options` is light to import (no torch, no cv2), for the command line's help.
"""
