"""Inverse kinematics of any model that predicts positions or poses."""
