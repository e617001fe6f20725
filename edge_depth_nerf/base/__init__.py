"""What every room uses: errors, bounds of what is read, files written whole, the terminal, pictures."""
