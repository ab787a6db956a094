"""The paper's figures and tables by number, from committed results and from what this package has."""
