"""The person: skeleton, body, dimensions, angles."""
