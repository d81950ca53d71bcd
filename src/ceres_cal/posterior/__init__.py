"""What is known of every number: information, valleys along phi, other explanations, maps over the field."""
