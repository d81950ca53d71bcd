"""What simulated observations say of answers: how near, how honest, how often wrong."""
