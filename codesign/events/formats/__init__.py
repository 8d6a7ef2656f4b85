"""One file per event file format; ``codesign.events.files`` chooses among them by extension."""
