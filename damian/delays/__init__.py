"""How long messages take: delay laws, samplers that draw from them, and a line that holds messages back."""
