"""Published experiments, one folder each: study.py runs it, runs.py and figures.py serve it."""
