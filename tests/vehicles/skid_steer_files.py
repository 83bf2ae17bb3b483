"""URDF and xacro texts of small rovers for the tests."""

ROVER = """<?xml version="1.0"?>
<robot name="rover" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:arg name="payload" default="0.0"/>
  <xacro:arg name="radius" default="0.15"/>
  <xacro:property name="r" value="$(arg radius)"/>
  <link name="base_link">
    <inertial><origin xyz="0.02 0 0.1"/><mass value="${20 + float('$(arg payload)')}"/>
      <inertia ixx="0.5" iyy="0.8" izz="1.1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><origin xyz="0 0 0.1"/><geometry><box size="0.6 0.3 0.2"/></geometry></visual>
  </link>
  <xacro:macro name="wheel" params="name x y">
    <link name="${name}">
      <inertial><mass value="1.5"/>
        <inertia ixx="0.009" iyy="0.009" izz="0.017" ixy="0" ixz="0" iyz="0"/></inertial>
      <collision><geometry><cylinder radius="${r}" length="0.08"/></geometry></collision>
    </link>
    <joint name="${name}_joint" type="continuous">
      <parent link="base_link"/><child link="${name}"/>
      <origin xyz="${x} ${y} 0" rpy="${-pi / 2} 0 0"/><axis xyz="0 0 1"/>
    </joint>
  </xacro:macro>
  <xacro:wheel name="rr" x="-0.2" y="-0.25"/>
  <xacro:wheel name="fl" x="0.2" y="0.25"/>
  <xacro:wheel name="fr" x="0.2" y="-0.25"/>
  <xacro:wheel name="rl" x="-0.2" y="0.25"/>
</robot>
"""
