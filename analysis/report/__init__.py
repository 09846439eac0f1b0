"""Reports: self-contained HTML pages of an identification, a trace or a loop."""
