"""What a run shows: figures and one self-contained HTML page."""
