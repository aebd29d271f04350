"""Collision refinement: moves vertices away from a surface to which they are too close, and the cloth around them."""

from .body_contacts import BodyContacts, contacts
from .contact_set import ContactFrame, Contacts, ContactSource
from .solver import CollisionSolver, refine

__all__ = ["BodyContacts", "CollisionSolver", "ContactFrame", "ContactSource", "Contacts", "contacts", "refine"]
