"""From an unknown motor to its parameters with error bars: experiments, estimators, files."""
