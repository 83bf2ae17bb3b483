"""What a vehicle is: its parameters, its body, its rotors and wheels."""
