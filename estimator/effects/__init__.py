"""Effects that the error model may lack: their regressors, what excites them, what they are confused with."""
