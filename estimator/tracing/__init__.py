"""From residuals to the effect that the model lacks: evidence, search, and the error before and after."""
