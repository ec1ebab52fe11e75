"""The sorting cycle: states and transitions, the handler of each state, the targets followed over their retries."""
