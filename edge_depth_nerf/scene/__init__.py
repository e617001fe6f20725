"""The scene folder: its format, its one reader and its one writer. No nerfstudio."""
