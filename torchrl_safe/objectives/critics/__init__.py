"""The critics of the costs, of states and of actions, and their value estimators."""
