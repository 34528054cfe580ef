"""Effects that the error model may lack: their regressors, what excites them, what they are confused with."""

GROUP = "turntable_station.effects"
"""Entry points of packages that bring effects of their own: each names a record, or several in a sequence."""
