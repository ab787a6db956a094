"""The paper's figures and tables by number, from committed results and from this package's presets and tasks."""
