"""What the models and estimators promise, measured over random cases."""
