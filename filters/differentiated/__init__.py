"""The log-likelihood of a page's innovations with its derivatives along parameters of the model."""
