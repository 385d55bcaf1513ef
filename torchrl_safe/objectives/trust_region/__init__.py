"""Trust-region methods: one step of the policy for each batch."""
