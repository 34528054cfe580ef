"""Effects that the error model may lack: their regressors, what excites them, which others they resemble."""
